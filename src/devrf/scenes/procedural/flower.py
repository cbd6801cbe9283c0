"""The flower: a stem that bends and twists, petals that curl open (non-rigid motion)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.procedural.motion import Bending, Swing, length, rotation, stretch, turn
from devrf.scenes.procedural.solids import (
    Material,
    Paint,
    PaintedParts,
    Rgb,
    rounded_box,
    rounded_cylinder,
)

# Share of the opening that a petal turns by at its hinge; the rest builds up towards its tip.
_AT_HINGE = 0.6


def _frame(azimuth: float, elevation: float, out: float, up: float) -> tuple[Tensor, Tensor]:
    """Axes (3, 3) as columns (along, across, normal) and hinge (3,) of a blade, float64.

    Its hinge is ``out`` from the z axis in the direction ``azimuth`` and ``up`` above the origin.
    """
    around = rotation((0, 0, 1), azimuth)
    hinge = around @ torch.tensor([out, 0, 0], dtype=torch.float64)
    hinge = hinge + torch.tensor([0, 0, up], dtype=torch.float64)
    return around @ rotation((0, 1, 0), -elevation), hinge


@dataclass(frozen=True)
class Blade:
    """A pointed lens that starts at its hinge, where two equal discs overlap; world units.

    Attributes:
        half_length: half of its length.
        half_width: half of its width.
        thickness: its half thickness.
    """

    half_length: float
    half_width: float
    thickness: float

    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Distance (M,) of points along, across and above it."""
        a = self.half_length
        b = self.half_width
        # A disc with its centre on the y axis that passes the tip (a, 0) and the side (0, b).
        offset = (a**2 - b**2) / (2 * b)
        ax = (x - a).abs()
        ay = y.abs()
        on_arc = torch.hypot(ax, ay + offset) - (offset + b)
        facing_arc = (ay + offset) * a >= offset * ax
        lens = torch.where(facing_arc, on_arc, torch.hypot(ax - a, ay))
        return torch.hypot(lens.clamp_min(0), z) - self.thickness


@dataclass(frozen=True)
class Leaf:
    """A leaf on the canonical stem; lengths in world units, angles in radians.

    Attributes:
        height: its height on the stem.
        azimuth: direction in which it points.
        elevation: angle above the horizon.
        blade: its shape.
        paint: its texture.
    """

    height: float
    azimuth: float
    elevation: float
    blade: Blade
    paint: Paint


@dataclass(frozen=True)
class Whorl:
    """A ring of equal petals around the z axis that open and close together.

    A petal curls in the plane of the blossom's axis and its own: each point turns about the
    hinge by an angle that depends on its distance ρ from the hinge in that plane. Lengths in
    world units, angles in radians; ``opening`` arguments are 0 canonically and 1 when open.

    Attributes:
        first_part: part number of petal 0; the others follow.
        count: number of petals.
        hinge: distance of the hinges from the blossom's axis.
        elevation: canonical angle of the petals above the horizon.
        opening: by how much their tips turn downward when open.
        blade: a petal's shape.
        paints: textures of the petals with even and with odd numbers.
    """

    first_part: int
    count: int
    hinge: float
    elevation: float
    opening: float
    blade: Blade
    paints: tuple[Paint, Paint]

    def nearest(self, points: Tensor) -> Tensor:
        """Number (M,) of the petal whose sector holds each point (M, 3).

        The petals are equal and each is its own mirror image, so none is nearer.
        """
        sector = torch.atan2(points[:, 1], points[:, 0]) * (self.count / (2 * math.pi))
        return sector.round().long().remainder(self.count)

    def distance(self, points: Tensor, opening: float) -> Tensor:
        """Lower bound (M,) of the distance of points (M, 3) to the nearest petal."""
        x, y, z = self._at_hinge(points, self.nearest(points))
        x, z = self._curl(x, z, -opening)
        x, z = turn(x, z, -self.elevation)
        shear = abs(self.opening * opening) * (1 - _AT_HINGE)
        return self.blade.distance(x, y, z) / stretch(shear)

    def curled(self, points: Tensor, petal: Tensor, opening: float) -> Tensor:
        """Points (M, 3) of the petals (M,), opened; the opposite opening undoes it."""
        x, y, z = self._at_hinge(points, petal)
        x, z = self._curl(x, z, opening)
        x, y = turn(x + self.hinge, y, self._azimuth(petal, x))
        return torch.stack([x, y, z + HEAD], dim=-1)

    def _curl(self, x: Tensor, z: Tensor, opening: float) -> tuple[Tensor, Tensor]:
        """Turn (x, z) about the hinge downward by opening · (share at hinge … 1 at the tip)."""
        rho = torch.hypot(x, z) / (2 * self.blade.half_length)
        share = _AT_HINGE + (1 - _AT_HINGE) * rho.clamp_max(1)
        return turn(x, z, -self.opening * opening * share)

    def _azimuth(self, petal: Tensor, like: Tensor) -> Tensor:
        return petal.to(like) * (2 * math.pi / self.count)

    def _at_hinge(self, points: Tensor, petal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coordinates outward, across and up from the petal's hinge."""
        x, y = turn(points[:, 0], points[:, 1], -self._azimuth(petal, points))
        return x - self.hinge, y, points[:, 2] - HEAD


BASE = -0.66  # height at which the stem leaves the soil: the centre of the bending
HEAD = 0.30  # height of the blossom's middle
STEM_RADIUS = 0.055
HEART = 0.14  # radius of the ball in the blossom's middle
POT_CENTER = -0.83
POT_RADIUS = 0.34
POT_HALF_HEIGHT = 0.19
POT_ROUNDING = 0.06

# Part numbers: pot, stem, heart, then the leaves, then the petals.
POT = 0
FIRST_LEAF = 3
FIRST_PETAL = 6

MAGENTA: Rgb = (0.84, 0.10, 0.45)
ROSE: Rgb = (0.98, 0.62, 0.75)
VIOLET: Rgb = (0.42, 0.22, 0.70)
LILAC: Rgb = (0.80, 0.70, 0.97)
GOLD: Rgb = (1.00, 0.80, 0.18)
AMBER: Rgb = (0.96, 0.50, 0.08)
CREAM: Rgb = (1.00, 0.94, 0.76)
BROWN: Rgb = (0.35, 0.17, 0.08)
LEAF_GREEN: Rgb = (0.12, 0.48, 0.20)
SPRING: Rgb = (0.62, 0.82, 0.28)
TERRACOTTA: Rgb = (0.78, 0.36, 0.20)

# A petal's paint starts at its hinge: cos is 1 there, so that the accent glows at the heart.
OUTER = Whorl(
    first_part=FIRST_PETAL,
    count=8,
    hinge=0.10,
    elevation=0.62,
    opening=0.8,
    blade=Blade(0.3, 0.145, 0.022),
    paints=(Paint(MAGENTA, ROSE, (0.3, 0, 0), 0.1, 5), Paint(VIOLET, LILAC, (0.3, 0, 0), 0.1, 5)),
)
INNER = Whorl(
    first_part=FIRST_PETAL + OUTER.count,
    count=6,
    hinge=0.07,
    elevation=1.05,
    opening=0.5,
    blade=Blade(0.19, 0.095, 0.02),
    paints=(Paint(AMBER, CREAM, (0.34, 0, 0), 0.2, 4), Paint(GOLD, CREAM, (0.34, 0, 0), 0.2, 4)),
)
WHORLS = (OUTER, INNER)

LEAVES = (
    Leaf(-0.50, 0.5, 0.55, Blade(0.27, 0.12, 0.02), Paint(LEAF_GREEN, SPRING, (0.22, 0, 0), 0.2)),
    Leaf(-0.32, 3.4, 0.60, Blade(0.25, 0.11, 0.02), Paint(SPRING, LEAF_GREEN, (0, 0.2, 0), 0.2)),
    Leaf(-0.16, 1.9, 0.65, Blade(0.20, 0.10, 0.02), Paint(LEAF_GREEN, SPRING, (0.18, 0, 0), 0.1)),
)

POT_PAINT = Paint(TERRACOTTA, CREAM, (0, 0, 0.26), 0.3)
STEM_PAINT = Paint(LEAF_GREEN, SPRING, (0, 0, 0.24), 0.0)
HEART_PAINT = Paint(BROWN, GOLD, (0.14, 0.14, 0), 0.2, 5)


# The distances from the stem's base between which bending and twisting build up: no turn below, one
# rigid turn above, which leaves the blossom undistorted.
_RAMP = (0.05, 0.85)
_BENDING = Bending(_RAMP, ((0, 1, Swing(0.6, 1.4, -0.4)), (2, 0, Swing(0.66, 1.2, -0.1))))
_OPENING = Swing(1.0, 1.7, -0.5)
_BASE = (0.0, 0.0, BASE)
_STEM_MIDDLE = (HEAD + BASE) / 2
_STEM_HALF = (HEAD - BASE) / 2


def _painted() -> PaintedParts:
    """The paints of all parts in the order of their numbers."""
    frames = [_frame(0, 0, 0, height) for height in (POT_CENTER, _STEM_MIDDLE, HEAD)]
    paints = [POT_PAINT, STEM_PAINT, HEART_PAINT]
    for leaf in LEAVES:
        frames.append(_frame(leaf.azimuth, leaf.elevation, 0, leaf.height))
        paints.append(leaf.paint)
    for whorl in WHORLS:
        for k in range(whorl.count):
            azimuth = k * 2 * math.pi / whorl.count
            frames.append(_frame(azimuth, whorl.elevation, whorl.hinge, HEAD))
            paints.append(whorl.paints[k % 2])
    axes, origins = zip(*frames, strict=True)
    return PaintedParts(paints, torch.stack(origins), torch.stack(axes))


_PAINTED = _painted()


@dataclass(frozen=True)
class Flower:
    """A non-rigid :class:`~devrf.scenes.procedural.solids.Shape`; parts: pot, stem, … petals.

    A petal first curls about its hinge, by an angle that grows with the distance from it; then
    all but the pot turns about the stem's base, by angles that grow with the distance from it.
    Both keep that distance, so both are undone exactly.

    Attributes:
        speed: scales bending, twisting and curling.
    """

    speed: float = 1.0

    def distance(self, points: Tensor, time: float) -> Tensor:
        """A lower bound (M,): canonical distances over the largest stretch of the motion."""
        return self._distances(points, self._unbent(points, time), time).amin(dim=0)

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest part's material: unbent, and for a petal uncurled."""
        canonical = self._unbent(points, time)
        kind = self._distances(points, canonical, time).argmin(dim=0)
        part = kind.clone()
        canonical = torch.where((kind == POT)[:, None], points, canonical)
        opening = _OPENING(self.speed, time)
        for own_kind, whorl in enumerate(WHORLS, start=FIRST_PETAL):
            own = kind == own_kind
            petal = whorl.nearest(canonical)
            part = torch.where(own, whorl.first_part + petal, part)
            canonical = torch.where(
                own[:, None], whorl.curled(canonical, petal, -opening), canonical
            )
        return Material(canonical, part)

    def forward(self, material: Material, time: float) -> Tensor:
        """Curl, then bend and twist; the pot stays."""
        points = material.canonical
        opening = _OPENING(self.speed, time)
        for whorl in WHORLS:
            petal = material.part - whorl.first_part
            own = (petal >= 0) & (petal < whorl.count)
            curled = whorl.curled(points, petal.clamp(0, whorl.count - 1), opening)
            points = torch.where(own[:, None], curled, points)
        base = points.new_tensor(_BASE)
        moved = _BENDING.bent(points - base, self.speed, time) + base
        return torch.where((material.part == POT)[:, None], material.canonical, moved)

    def color(self, material: Material) -> Tensor:
        """The parts' paints."""
        return _PAINTED.color(material)

    def outline(self) -> Material:
        """A grid of points over the box around each part, in its own frame."""
        half = [
            (POT_RADIUS, POT_RADIUS, POT_HALF_HEIGHT),
            (STEM_RADIUS, STEM_RADIUS, _STEM_HALF),
            (HEART, HEART, HEART),
        ]
        middle = [(0.0, 0.0, 0.0)] * len(half)
        petals = [whorl.blade for whorl in WHORLS for _ in range(whorl.count)]
        for blade in [leaf.blade for leaf in LEAVES] + petals:
            a = blade.half_length
            b = blade.half_width
            t = blade.thickness
            half.append((a + t, b + t, t))
            # A blade's frame starts at its hinge.
            middle.append((a, 0.0, 0.0))
        return _PAINTED.outline(torch.tensor(half), torch.tensor(middle))

    def _unbent(self, points: Tensor, time: float) -> Tensor:
        base = points.new_tensor(_BASE)
        return _BENDING.unbent(points - base, self.speed, time) + base

    def _distances(self, points: Tensor, unbent: Tensor, time: float) -> Tensor:
        """(kinds, M) safe distances: pot, stem, heart, the leaves, the whorls."""
        x, y, z = points.unbind(-1)
        pot = rounded_cylinder(x, y, z - POT_CENTER, POT_RADIUS, POT_HALF_HEIGHT, POT_ROUNDING)
        x, y, z = unbent.unbind(-1)
        r = STEM_RADIUS
        stem = rounded_box(x, y, z - _STEM_MIDDLE, (r, r, _STEM_HALF), r)
        heart = length(unbent - unbent.new_tensor([0.0, 0.0, HEAD])) - HEART
        leaves = []
        for number, leaf in enumerate(LEAVES, start=FIRST_LEAF):
            axes = _PAINTED.rotation[number]
            hinge = _PAINTED.origin[number]
            local = (unbent - hinge.to(unbent)) @ axes.to(unbent)
            x, y, z = local.unbind(-1)
            leaves.append(leaf.blade.distance(x, y, z))
        petals = [whorl.distance(unbent, _OPENING(self.speed, time)) for whorl in WHORLS]
        bending = torch.stack([stem, heart, *leaves, *petals])
        # Beyond the ramp the motion is rigid: up to the ramp's end, distances hold as they are.
        rigid = length(unbent - unbent.new_tensor(_BASE)) - _RAMP[1]
        slack = 1 / _BENDING.stretch(self.speed, time)
        bending = torch.maximum(slack * bending, torch.minimum(bending, rigid))
        return torch.cat([pot[None], bending])
