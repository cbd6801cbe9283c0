"""Axis-aligned boxes: their voxels, their grid points, and their crossings with rays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.rays import Rays

# A grid has at most so many times the voxels that were asked for: of two along a thin axis.
THINNEST = 16


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the fields' space (world units, or NDC).

    Attributes:
        low: the corner (x, y, z) with the smallest coordinates.
        high: the corner (x, y, z) with the largest coordinates.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        corners = zip(self.low, self.high, strict=True)
        if not all(-math.inf < a < b < math.inf for a, b in corners):
            raise ValueError(f"a box needs low < high on every axis, not {self.low}, {self.high}")

    def __str__(self) -> str:
        """Both corners with three digits, for people."""
        low, high = (" ".join(f"{v:.3g}" for v in corner) for corner in (self.low, self.high))
        return f"[{low}] to [{high}]"

    @property
    def size(self) -> tuple[float, float, float]:
        """Edge lengths (x, y, z)."""
        x, y, z = (b - a for a, b in zip(self.low, self.high, strict=True))
        return x, y, z

    @property
    def middle(self) -> tuple[float, float, float]:
        """The centre (x, y, z)."""
        x, y, z = ((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))
        return x, y, z

    def moved(self, by: tuple[float, float, float]) -> Box:
        """The box moved along (x, y, z)."""
        return Box.of(
            [v + step for v, step in zip(self.low, by, strict=True)],
            [v + step for v, step in zip(self.high, by, strict=True)],
        )

    @property
    def longest(self) -> float:
        """The longest edge."""
        return max(self.size)

    @property
    def diagonal(self) -> float:
        """The distance of opposite corners."""
        return math.hypot(*self.size)

    @property
    def volume(self) -> float:
        """Product of the edge lengths."""
        x, y, z = self.size
        return x * y * z

    def voxel_size(self, voxels: int) -> float:
        """s = (volume / N)^(1/3): the edge of each of ``voxels`` equal cubes.

        See docs/method.md#notation.
        """
        return float((self.volume / voxels) ** (1 / 3))

    def grid_shape(
        self, voxels: int, planes: int | None = None, aspect: float = 1.0
    ) -> tuple[int, int, int]:
        """Grid points along (x, y, z) for about ``voxels`` cubic voxels: floor(size / s).

        At least two along each axis, since grid corners sit on the box's corners.

        Args:
            voxels: their number, about.
            planes: points along z; then voxels are square along x and y. None: they are cubes.
            aspect: with planes, points across a unit of x to those across a unit of y.
        """
        width, height, _ = self.size
        if planes is None:
            sides = [edge / self.voxel_size(voxels) for edge in self.size]
        else:
            edge = (width * height * planes / voxels) ** 0.5
            wider = aspect**0.5
            sides = [width * wider / edge, height / wider / edge, planes]
        # 1e-6 is added so that a cube of 10^3 voxels has side 10 in spite of rounding.
        x, y, z = (max(2, int(side + 1e-6)) for side in sides)
        if x * y * z > THINNEST * (voxels + 8):
            raise DevrfError(f"a box of {self} is too thin for {voxels} voxels; make it thicker")
        return x, y, z

    def scaled(self, factor: float) -> Box:
        """The box grown about its centre by ``factor`` along every axis."""
        ends = [(m, e / 2 * factor) for m, e in zip(self.middle, self.size, strict=True)]
        return Box.of([m - half for m, half in ends], [m + half for m, half in ends])

    def union(self, other: Box) -> Box:
        """The smallest box that holds both."""
        return Box.of(list(map(min, self.low, other.low)), list(map(max, self.high, other.high)))

    def clipped(self, other: Box) -> Box:
        """The part of this box inside ``other``."""
        return Box.of(list(map(max, self.low, other.low)), list(map(min, self.high, other.high)))

    def contains(self, points: Tensor) -> Tensor:
        """Mask (...,) of the points (..., 3) inside the box, faces included."""
        low, high = self.corners(points)
        return ((points >= low) & (points <= high)).all(dim=-1)

    def nearest(self, points: Tensor) -> Tensor:
        """The nearest points (..., 3) of the box, inside included."""
        low, high = self.corners(points)
        return points.clamp(low, high)

    def corners(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """The two corners (3,) as tensors with the dtype and device of ``like``; to be read only.

        They are made once: a tensor made of Python's numbers at every step would make the device
        wait for the host.
        """
        return (
            constant(self.low, like.dtype, like.device),
            constant(self.high, like.dtype, like.device),
        )

    def to_grid(self, points: Tensor, shape: tuple[int, int, int]) -> Tensor:
        """Grid coordinates (..., 3): 0 on the low faces, shape − 1 on the high ones."""
        low, high = self.corners(points)
        extent = constant(shape, points.dtype, points.device) - 1
        return (points - low) * (extent / (high - low))

    def grid_points(self, shape: tuple[int, int, int], like: Tensor) -> Tensor:
        """(X, Y, Z, 3) positions of a grid whose corners sit on the box's corners."""
        return torch.stack(torch.meshgrid(*self.grid_lines(shape, like), indexing="ij"), dim=-1)

    def grid_lines(self, shape: tuple[int, int, int], like: Tensor) -> list[Tensor]:
        """Coordinates of :meth:`grid_points` along each axis: (X,), (Y,) and (Z,)."""
        return [
            torch.linspace(a, b, n, dtype=like.dtype, device=like.device)
            for a, b, n in zip(self.low, self.high, shape, strict=True)
        ]

    def crossing(
        self, rays: Rays, near: float = -math.inf, far: float = math.inf
    ) -> tuple[Tensor, Tensor]:
        """Distances (M,), (M,) at which rays enter and leave the box, within [near, far].

        A ray that misses has entry > exit; entry is negative for a ray that starts inside, if
        ``near`` is.
        """
        low, high = self.corners(rays.origins)
        return rays.crossing(low, high, near, far)

    @staticmethod
    def of(low: Tensor | list[float], high: Tensor | list[float]) -> Box:
        """A box from two sequences or tensors of three numbers."""
        a, b, c = (float(v) for v in low)
        d, e, f = (float(v) for v in high)
        return Box((a, b, c), (d, e, f))


@lru_cache(maxsize=256)
def constant(numbers: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Numbers (N,) as a tensor that is made once; to be read only."""
    # A tensor made in inference mode could not be used for training later.
    with torch.inference_mode(False):
        return torch.tensor(numbers, dtype=dtype, device=device)
