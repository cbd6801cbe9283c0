"""Fully connected trunks."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Trunk(nn.Module):
    """Layers of equal width with ReLU; the input enters once more in the middle.

    Attributes:
        width: units of each layer, and of the result.
    """

    def __init__(self, inputs: int, width: int, depth: int, skipped: int | None = None) -> None:
        """Build the layers.

        Args:
            inputs: length of the input.
            width: units of each layer.
            depth: how many layers.
            skipped: how much of the input, from its beginning, enters the middle layer again;
                None: all of it.
        """
        super().__init__()
        self.width = width
        self._skipped = inputs if skipped is None else skipped
        self._middle = depth // 2 if depth > 2 else -1
        sizes = [inputs, *[width] * (depth - 1)]
        self.layers = nn.ModuleList(
            nn.Linear(size + (self._skipped if k == self._middle else 0), width)
            for k, size in enumerate(sizes)
        )

    def forward(self, values: Tensor) -> Tensor:
        """(M, width) of ``values`` (M, inputs)."""
        x = values
        for k, layer in enumerate(self.layers):
            if k == self._middle:
                x = torch.cat([x, values[:, : self._skipped]], dim=-1)
            x = torch.relu(layer(x))
        return x
