"""Parts of radiance fields: encodings, trunks, codes of frames, and the field itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from devrf.geometry.clock import FrameClock
from devrf.methods.nerf.settings import Initialisation, PlacedSettings


class SinusoidalEncoding(nn.Module):
    """γ(x) = x ⊕ sin(2^k ω x) ⊕ cos(2^k ω x), k = 0 … bands − 1 (docs/methods/dnerf.md#encoding).

    Attributes:
        size: length of the encoding of a vector.
    """

    octaves: Tensor

    def __init__(
        self, dimensions: int, bands: int, *, first: float = 1.0, identity: bool = True
    ) -> None:
        """For vectors of so many ``dimensions``, themselves left out without ``identity``.

        ``first`` is ω, the angular frequency of the first octave.
        """
        super().__init__()
        self.register_buffer("octaves", first * 2.0 ** torch.arange(bands), persistent=False)
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


def mlp(inputs: int, width: int, depth: int, outputs: int, *, bias: bool = True) -> nn.Sequential:
    """Linear layers, ``depth`` hidden ones of ``width`` units, with ReLU between."""
    sizes = [inputs, *[width] * depth]
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Linear(before, after, bias=bias), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs, bias=bias))


def octave_window(opened: Tensor, bands: int) -> Tensor:
    """w_k(α) = ½ (1 − cos(π · clamp(α − k, 0, 1))) for k = 0 … bands − 1: coarse octaves first.

    See docs/methods/nerfies.md#window.

    Args:
        opened: () α: the number of open octaves; 0 shuts all, ``bands`` opens all.
        bands: octaves.

    Returns:
        (bands,) factors in [0, 1].
    """
    octave = torch.arange(bands, device=opened.device)
    return (1 - torch.cos(math.pi * (opened - octave).clamp(0, 1))) / 2


def linear_by_ray(
    layer: nn.Linear, values: Sequence[Tensor], of_rays: Tensor, ray: Tensor
) -> Tensor:
    """``layer(cat([*values, of_rays[ray]], dim=1))``, whose last part is multiplied once a ray.

    No gradient is computed of values that need none, as encoded positions.

    Args:
        layer: of as many inputs as all of these have.
        values: numbers (S, ·) of samples.
        of_rays: (R, ·) numbers of rays.
        ray: (S,) the ray of each sample.

    Returns:
        (S, units).
    """
    sizes = [part.shape[1] for part in (*values, of_rays)]
    *weights, of_ray = torch.split(layer.weight, sizes, dim=1)
    total = nn.functional.linear(of_rays, of_ray, layer.bias).index_select(0, ray)
    for part, weight in zip(values, weights, strict=True):
        total = torch.addmm(total, part, weight.t())
    return total


class Trunk(nn.Module):
    """Layers of equal width with ReLU; the input enters once more on the way.

    Attributes:
        beside: the weights of a second input, apart from the others, so that they can be learned
            where the others stay as they are.
    """

    def __init__(
        self,
        inputs: int,
        width: int,
        depth: int,
        skip: int | None,
        skipped: int | None = None,
        beside: int = 0,
    ) -> None:
        """Build the layers.

        Args:
            inputs: length of the input.
            width: units of each layer, and of the result.
            depth: the number of layers.
            skip: number, from 0, of the layer that the input enters again; None: the middle one, of
                a trunk of three or more. A trunk without that layer has no such input.
            skipped: the length of the input's part, from its beginning, that does; None: all of it.
            beside: length of a second input that enters with the first one, both times.
        """
        super().__init__()
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

    def forward(self, values: Tensor, beside: Tensor | None = None) -> Tensor:
        """(M, width) of ``values`` (M, inputs), and of ``beside`` (M, beside) if that enters."""
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

    ``uniform``: as PyTorch has made them; ``glorot``: weights uniform in
    ±√(6 / (inputs + outputs)), biases 0.
    """
    for layer in network.modules():
        if how == "glorot" and isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


# Codes begin uniform in [0, LARGEST).
LARGEST = 0.05


class TimeCodes(nn.Module):
    """A code ω_t for each frame, shared by all cameras; between two frames a mixture of theirs.

    The codes at frames' own times are the published ones; those between were never learned
    (docs/methods/nerfies.md#codes).
    """

    def __init__(self, times: Sequence[float], size: int) -> None:
        """Draw codes of length ``size`` for frames at ``times`` in [0, 1], ascending from 0."""
        super().__init__()
        self.clock = FrameClock(tuple(times))
        self.table = nn.Embedding(len(self.clock), size)
        nn.init.uniform_(self.table.weight, 0, LARGEST)

    def forward(self, time: Tensor) -> Tensor:
        """Codes (M, size) at times (M,) in [0, 1]."""
        before, after, weight = self.clock.between(time)
        code: Tensor = torch.lerp(self.table(before), self.table(after), weight[:, None])
        return code


class ColorBranch(nn.Module):
    """Colours a trunk's result by the viewing direction: NeRF's last layers."""

    def __init__(self, width: int, bands: int) -> None:
        """For a trunk of ``width`` units; directions have so many ``bands``."""
        super().__init__()
        self.encode = SinusoidalEncoding(3, bands)
        self.feature = nn.Linear(width, width)
        self.hidden = nn.Linear(width + self.encode.size, width // 2)
        self.output = nn.Linear(width // 2, 3)

    def forward(self, trunk: Tensor, viewdirs: Tensor, ray: Tensor) -> Tensor:
        """RGB (S, 3) before its activation.

        Samples (S, width) are of the rays ``ray`` (S,), whose unit directions are (R, 3).
        """
        direction = self.encode(viewdirs)
        hidden = linear_by_ray(self.hidden, [self.feature(trunk)], direction, ray).relu_()
        logits: Tensor = self.output(hidden)
        return logits


class RadianceField(nn.Module):
    """(x, d) → (σ, c): a trunk over γ(x), a density head, and a colour branch over γ(d)."""

    def __init__(
        self,
        settings: PlacedSettings,
        *,
        inputs: int = 3,
        ambient: int = 0,
    ) -> None:
        """Build the network.

        Args:
            settings: sizes.
            inputs: length of x; a time may be a part of it.
            ambient: length of the trunk's input beside γ(x).
        """
        super().__init__()
        s = self._settings = settings
        self.encode_position = SinusoidalEncoding(inputs, s.bands)
        self.trunk = Trunk(self.encode_position.size, s.width, s.depth, s.skip, beside=ambient)
        self.density = nn.Linear(s.width, 1)
        self.color = ColorBranch(s.width, s.direction_bands)
        initialise(self, s.initialisation)

    def hidden(self, points: Tensor, ambient: Tensor | None = None) -> Tensor:
        """Hidden features (S, width), from which density and colour come.

        Args:
            points: (S, inputs) in normalised space, [−1, 1] inside the box.
            ambient: (S, ambient) input beside γ(x), or None.
        """
        x: Tensor = self.trunk(self.encode_position(points), ambient)
        return x

    def sigma(self, points: Tensor, ambient: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """σ (S,) ≥ 0 per unit of normalised space, and its hidden features; arguments likewise."""
        x = self.hidden(points, ambient)
        raw = self.density(x)[:, 0]
        return nn.functional.softplus(raw) * self._settings.density_scale, x

    def rgb(self, hidden: Tensor, viewdirs: Tensor, ray: Tensor) -> Tensor:
        """RGB (S, 3) in [0, 1] of samples of the rays ``ray`` (S,), whose directions are (R, 3)."""
        return torch.sigmoid(self.color(hidden, viewdirs, ray))
