"""What radiance fields are made of: encodings, trunks, codes of frames, and the field itself."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from devrf.geometry.clock import FrameClock


class SinusoidalEncoding(nn.Module):
    """γ(x) = x ⊕ sin(2^k x) ⊕ cos(2^k x) for k = 0 … bands − 1 (docs/methods/dnerf.md#encoding).

    Attributes:
        size: length of the encoding of a vector.
    """

    octaves: Tensor

    def __init__(self, dimensions: int, bands: int, *, identity: bool = True) -> None:
        """Build the encoding.

        Args:
            dimensions: length of the vectors.
            bands: octaves; 0 gives the vector alone.
            identity: whether the vector itself is a part of its encoding.
        """
        super().__init__()
        self.register_buffer("octaves", 2.0 ** torch.arange(bands), persistent=False)
        self._identity = identity
        self.size = dimensions * (identity + 2 * bands)

    def forward(self, values: Tensor, window: Tensor | None = None) -> Tensor:
        """Encodings (..., size) of ``values`` (..., dimensions).

        Args:
            values: the vectors.
            window: (bands,) factors of the octaves; the vector itself has none. None: all 1.
        """
        angles = (values[..., None, :] * self.octaves[:, None]).flatten(-2)
        waves = [angles.sin(), angles.cos()]
        if window is not None:
            factor = window.repeat_interleave(values.shape[-1])
            waves = [wave * factor for wave in waves]
        return torch.cat([values, *waves] if self._identity else waves, dim=-1)


def octave_window(opened: Tensor, bands: int) -> Tensor:
    """w_k(α) = ½ (1 − cos(π · clamp(α − k, 0, 1))) for k = 0 … bands − 1: coarse octaves first.

    See docs/methods/nerfies.md#window.

    Args:
        opened: () α: how many octaves are open; 0 shuts all, ``bands`` opens all.
        bands: octaves.

    Returns:
        (bands,) factors in [0, 1].
    """
    octave = torch.arange(bands, device=opened.device)
    return (1 - torch.cos(math.pi * (opened - octave).clamp(0, 1))) / 2


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


# They begin uniform in [0, LARGEST).
LARGEST = 0.05


class TimeCodes(nn.Module):
    """A code ω_t for each frame, shared by all cameras; between two frames a mixture of theirs.

    At frames' own times this is what was published; what is between them was never learned
    (docs/methods/nerfies.md#codes).

    Attributes:
        clock: the frames' times.
    """

    def __init__(self, times: Sequence[float], size: int) -> None:
        """Draw the codes.

        Args:
            times: of the frames, in [0, 1], ascending from 0.
            size: length of a code.
        """
        super().__init__()
        self.clock = FrameClock(tuple(times))
        self.table = nn.Embedding(len(self.clock), size)
        nn.init.uniform_(self.table.weight, 0, LARGEST)

    def forward(self, time: Tensor) -> Tensor:
        """Codes (M, size) at times (M,) in [0, 1]."""
        before, after, weight = self.clock.between(time)
        code: Tensor = torch.lerp(self.table(before), self.table(after), weight[:, None])
        return code


class RadianceField(nn.Module):
    """(x, d) → (σ, c): a trunk over γ(x), a density head, and a colour branch over γ(d).

    Attributes:
        density_scale: σ = scale · softplus(raw), per unit of normalised space.
    """

    def __init__(
        self,
        width: int,
        depth: int,
        bands: int,
        direction_bands: int,
        density_scale: float,
        *,
        skip: int | None = None,
        ambient: int = 0,
        initialisation: Initialisation = "uniform",
    ) -> None:
        """Build the network.

        Args:
            width: units of each layer of the trunk.
            depth: layers of the trunk.
            bands: octaves of the position.
            direction_bands: octaves of the viewing direction.
            density_scale: what a softplus of 1 means, per unit of normalised space.
            skip: the layer of the trunk that γ(x) enters again; None: the middle one.
            ambient: length of what enters the trunk beside γ(x).
            initialisation: of all layers.
        """
        super().__init__()
        self.density_scale = density_scale
        self.encode_position = SinusoidalEncoding(3, bands)
        self.encode_direction = SinusoidalEncoding(3, direction_bands)
        self.trunk = Trunk(self.encode_position.size, width, depth, skip=skip, beside=ambient)
        self.density = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.branch = nn.Linear(width + self.encode_direction.size, width // 2)
        self.color = nn.Linear(width // 2, 3)
        initialise(self, initialisation)

    def own_parameters(self) -> Iterator[nn.Parameter]:
        """All but :meth:`ambient_parameters`."""
        beside = {id(one) for one in self.ambient_parameters()}
        return (one for one in self.parameters() if id(one) not in beside)

    def ambient_parameters(self) -> Iterator[nn.Parameter]:
        """The weights of what enters beside γ(x)."""
        return self.trunk.beside_weights()

    def forward(
        self, points: Tensor, viewdirs: Tensor, ray: Tensor, ambient: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Densities and colours of samples.

        Args:
            points: (S, 3) in normalised space, [−1, 1] inside the box.
            viewdirs: (R, 3) unit viewing directions of the rays.
            ray: (S,) int64, the ray of each sample.
            ambient: (S, ambient) what enters beside γ(x), or None where nothing does.

        Returns:
            σ (S,) ≥ 0 per unit of normalised space, and RGB (S, 3) in [0, 1].
        """
        x = self.trunk(self.encode_position(points), ambient)
        density = self._density(x)
        direction = self.encode_direction(viewdirs).index_select(0, ray)
        x = torch.relu(self.branch(torch.cat([self.feature(x), direction], dim=-1)))
        return density, torch.sigmoid(self.color(x))

    def sigma(self, points: Tensor, ambient: Tensor | None = None) -> Tensor:
        """σ (S,) alone, for samples whose colour does not count; arguments as above."""
        return self._density(self.trunk(self.encode_position(points), ambient))

    def _density(self, features: Tensor) -> Tensor:
        raw: Tensor = self.density(features)[:, 0]
        return nn.functional.softplus(raw) * self.density_scale
