"""Fully connected trunks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import torch
from torch import Tensor, nn

Initialisation = Literal["uniform", "glorot"]


class Trunk(nn.Module):
    """Layers of equal width with ReLU; the input enters once more on the way.

    Attributes:
        width: units of each layer, and of the result.
    """

    def __init__(
        self,
        inputs: int,
        width: int,
        depth: int,
        skipped: int | None = None,
        skip: int | None = None,
        beside: int = 0,
    ) -> None:
        """Build the layers.

        Args:
            inputs: length of the input.
            width: units of each layer.
            depth: how many layers.
            skipped: how much of the input, from its beginning, enters the layer ``skip`` again;
                None: all of it.
            skip: number of that layer, from 0; None: the middle one, of a trunk of three or more.
                A trunk without a layer of that number has no such input.
            beside: length of a second input that enters with the first one, both times. Its
                weights are apart from the others (:meth:`beside_weights`), so that they can be
                learned where the others stay as they are.
        """
        super().__init__()
        self.width = width
        self._skipped = inputs if skipped is None else skipped
        self._skip = skip if skip is not None else depth // 2 if depth > 2 else -1
        sizes = [inputs, *[width] * (depth - 1)]
        self.layers = nn.ModuleList(
            nn.Linear(size + (self._skipped if k == self._skip else 0), width)
            for k, size in enumerate(sizes)
        )
        entries = [k for k in (0, self._skip) if 0 <= k < depth] if beside else []
        self.beside = nn.ModuleDict(
            {str(k): nn.Linear(beside, width, bias=False) for k in dict.fromkeys(entries)}
        )

    def beside_weights(self) -> Iterator[nn.Parameter]:
        """Weights of the second input."""
        return self.beside.parameters()

    def forward(self, values: Tensor, beside: Tensor | None = None) -> Tensor:
        """(M, width) of ``values`` (M, inputs), and ``beside`` (M, beside) where that enters."""
        x = values
        for k, layer in enumerate(self.layers):
            if k == self._skip:
                x = torch.cat([x, values[:, : self._skipped]], dim=-1)
            x = layer(x)
            if beside is not None and str(k) in self.beside:
                x = x + self.beside[str(k)](beside)
            x = torch.relu(x)
        return x


def initialise(network: nn.Module, how: Initialisation) -> None:
    """Set the first values of all linear layers of a network.

    Args:
        network: its linear layers are changed.
        how: ``uniform``: as PyTorch has made them; ``glorot``: weights uniform in
            ±√(6 / (inputs + outputs)), biases 0.
    """
    if how == "uniform":
        return
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
