"""The protocol of shapes, signed distances, solid textures, and painted rounded boxes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


@dataclass(frozen=True)
class Material:
    """M material points, the same while the object moves.

    Attributes:
        canonical: (M, 3) positions at t = 0, world units.
        part: (M,) int64, the part of the object of each.
    """

    canonical: Tensor
    part: Tensor


class Shape(Protocol):
    """A textured solid that deforms; its state at t = 0 is the canonical one."""

    def distance(self, points: Tensor, time: float) -> Tensor:
        """Lower bound (M,) of the distance of ``points`` (M, 3) to the surface at ``time``.

        Zero on the surface only, negative inside.
        """
        ...

    def material(self, points: Tensor, time: float) -> Material:
        """The material at world ``points`` (M, 3) on (or near) the surface at ``time``.

        ``material(points, time).canonical`` is the exact backward warp.
        """
        ...

    def forward(self, material: Material, time: float) -> Tensor:
        """Positions (M, 3) of the material at ``time``, world units; canonical at t = 0."""
        ...

    def color(self, material: Material) -> Tensor:
        """Albedo (M, 3) in [0, 1]: it depends on the material alone, so it moves with it."""
        ...


class Body(Shape, Protocol):
    """A shape that stands alone, and knows its outline."""

    def outline(self) -> Material:
        """Canonical points around all its parts."""
        ...


# Lengths that a caller may give as a number, or as a tensor of one length for each primitive.
Length = float | Tensor


def rounded_box(
    x: Tensor, y: Tensor, z: Tensor, half: tuple[Length, Length, Length], rounding: Length
) -> Tensor:
    """A box with outer half edges ``half``, edges rounded by ``rounding`` ≤ min(half).

    A rounding equal to the two smaller half edges makes a capsule, to all three a ball.
    """
    qx, qy, qz = (c.abs() - (h - rounding) for c, h in zip((x, y, z), half, strict=True))
    px = qx.clamp_min(0)
    py = qy.clamp_min(0)
    pz = qz.clamp_min(0)
    outside = (px * px + py * py + pz * pz).sqrt()
    inside = torch.maximum(torch.maximum(qx, qy), qz).clamp_max(0)
    return outside + inside - rounding


def rounded_cylinder(
    x: Tensor, y: Tensor, z: Tensor, radius: float, half_height: float, rounding: float
) -> Tensor:
    """An upright cylinder about z with outer ``radius`` and ``half_height``, rims rounded."""
    across = torch.hypot(x, y) - (radius - rounding)
    up = z.abs() - (half_height - rounding)
    outside = torch.hypot(across.clamp_min(0), up.clamp_min(0))
    return outside + torch.maximum(across, up).clamp_max(0) - rounding


Xyz = tuple[float, float, float]
Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Paint:
    """Two colours mixed by a product of cosines along the part's axes.

    One period makes stripes, two a checkerboard, three a checkerboard in space; a threshold
    above zero shrinks the accent from half of the surface to spots.

    Attributes:
        base: colour where the pattern is low.
        accent: colour where the pattern is high, as at the part's origin.
        periods: length of a full period along x, y, z in world units; 0: constant along it.
        threshold: the value in −1 … 1 at which base turns into accent.
        sharpness: steepness of the edges. They stay soft, so that an image of about 100 pixels
            does not alias.
    """

    base: Rgb
    accent: Rgb
    periods: Xyz = (0.0, 0.0, 0.0)
    threshold: float = 0.0
    sharpness: float = 6.0


class PaintedParts:
    """The paints of K parts in the parts' own frames.

    Attributes:
        rotation: (K, 3, 3) canonical axes of each part as columns, world ← part.
        origin: (K, 3) canonical origin of each part, world units.
    """

    def __init__(
        self, paints: Sequence[Paint], origin: Tensor, rotation: Tensor | None = None
    ) -> None:
        """The table of ``paints`` (K of them); without ``rotation`` all parts are upright."""

        def table(rows: list[tuple[float, ...]]) -> Tensor:
            return torch.tensor(rows, dtype=torch.float64)

        upright = torch.eye(3, dtype=torch.float64).repeat(len(paints), 1, 1)
        self.rotation = upright if rotation is None else rotation
        self.origin = origin
        self._base = table([p.base for p in paints])
        self._accent = table([p.accent for p in paints])
        # Radians per world unit along the part's axes.
        self._wave = table(
            [tuple(2 * math.pi / q if q else 0.0 for q in p.periods) for p in paints]
        )
        self._edge = table([(p.threshold, p.sharpness) for p in paints])

    def color(self, material: Material) -> Tensor:
        """Albedo (M, 3) of the material."""
        canonical = material.canonical
        part = material.part
        offset = canonical - self.origin.to(canonical)[part]
        local = torch.einsum("mji,mj->mi", self.rotation.to(canonical)[part], offset)
        pattern = (local * self._wave.to(canonical)[part]).cos().prod(dim=-1)
        threshold, sharpness = self._edge.to(canonical)[part].unbind(-1)
        share = ((pattern - threshold) * sharpness).sigmoid()[:, None]
        return torch.lerp(self._base.to(canonical)[part], self._accent.to(canonical)[part], share)

    def outline(self, half: Tensor, middle: Tensor) -> Material:
        """A grid of points over the boxes around the parts; the box of the points holds the object.

        Args:
            half: (K, 3) half edges along the parts' axes, world units.
            middle: (K, 3) the middle of each box in its frame.
        """
        steps = torch.linspace(-1, 1, 7)
        cube = torch.cartesian_prod(steps, steps, steps)
        local = cube * half[:, None] + middle[:, None]
        points = torch.einsum("kij,kmj->kmi", self.rotation.float(), local)
        points = points + self.origin.float()[:, None]
        part = torch.arange(len(half)).repeat_interleave(len(cube))
        return Material(points.reshape(-1, 3), part)


@dataclass(frozen=True)
class Solid:
    """A rounded box; capsules and balls are boxes with large roundings.

    Attributes:
        center: its canonical centre, world units; the paint's origin too.
        half: outer half edges.
        rounding: radius of its edges.
        paint: its texture.
        link: name of the joint that moves it, "" for none.
    """

    center: Xyz
    half: Xyz
    rounding: float
    paint: Paint
    link: str = ""


class SolidTable:
    """K solids as tensors.

    Attributes:
        center: (K, 3) float64 centres as the solids give them.
        painted: their textures, in the world.
    """

    def __init__(self, solids: Sequence[Solid], base: Xyz = (0.0, 0.0, 0.0)) -> None:
        """Tables of ``solids`` whose centres are relative to ``base`` (world units)."""
        self.center = torch.tensor([s.center for s in solids], dtype=torch.float64)
        self._half = torch.tensor([s.half for s in solids])
        self._rounding = torch.tensor([s.rounding for s in solids])[:, None]
        origin = self.center + torch.tensor(base, dtype=torch.float64)
        self.painted = PaintedParts([s.paint for s in solids], origin)

    def distances(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Distance (K, M) to each solid of coordinates (K, M) about its centre, along its axes."""
        a, b, c = self._half.to(x).T[..., None]
        return rounded_box(x, y, z, (a, b, c), self._rounding.to(x))

    def distances_of(self, points: Tensor) -> Tensor:
        """Canonical distance (K, M) to each solid, of points (M, 3) relative to the base."""
        x, y, z = points.T[:, None] - self.center.to(points).T[..., None]
        return self.distances(x, y, z)

    def outline(self) -> Material:
        """Canonical points around the solids."""
        return self.painted.outline(self._half, torch.zeros_like(self._half))
