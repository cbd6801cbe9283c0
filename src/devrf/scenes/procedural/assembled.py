"""Bodies assembled from parts that carry each other, and turn, slide, bend, twist and are squashed.

All motion of parts can be undone exactly. Lengths in world units, angles in radians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from devrf.scenes.procedural.flower import Blade
from devrf.scenes.procedural.motion import Swing, length, rotation, stretch, turn
from devrf.scenes.procedural.solids import Material, Paint, PaintedParts, Xyz, rounded_box

NO_SWING = Swing(0.0, 1.0, 0.0)
# The most that a ramp 3u² − 2u³ over the distance u shears, per radian: u · 6u (1 − u) at 2/3.
BEND_SHEAR = 8 / 9
# Farther than this from a part's ball, the distance to the part is taken from the ball.
SHELL = 0.05


@dataclass(frozen=True, eq=False)
class Part:
    """One part; in its own frame it begins at the origin and leads along z.

    Attributes:
        kind: ``box``, ``capsule``, ``ellipsoid`` or ``blade``.
        half: half edges along its own x, y, z; a blade is thin along y.
        parent: number of the part that carries it, which stands before it; −1 for the world.
        base: (3,) float64, its canonical base, in the world.
        axes: (3, 3) float64, its canonical axes as columns.
        hinge: unit canonical axis about which it turns at its base, in the world.
        paint: its texture.
        swing: the angle about its hinge.
        slide: its displacement along its own axis.
        bend: the angle at its tip towards its x axis.
        twist: the angle at its tip about its z axis.
        squash: log of its length's factor; its volume stays.
        spin: the angle about its z axis, about which it is round.
    """

    kind: str
    half: Xyz
    parent: int
    base: Tensor
    axes: Tensor
    hinge: Xyz
    paint: Paint
    swing: Swing = NO_SWING
    slide: Swing = NO_SWING
    bend: Swing = NO_SWING
    twist: Swing = NO_SWING
    squash: Swing = NO_SWING
    spin: Swing = NO_SWING

    @property
    def along(self) -> float:
        """Its length."""
        return 2 * self.half[2]

    @property
    def reach(self) -> float:
        """Radius of a ball about its base that holds its canonical state."""
        return math.hypot(self.along, *self.half[:2])

    @property
    def rigid(self) -> bool:
        """Whether it keeps its form: it neither bends, nor twists, nor is squashed."""
        return {self.bend, self.twist, self.squash} == {NO_SWING}

    def distance(self, local: Sequence[Tensor]) -> Tensor:
        """Canonical lower bound (M,) of points (M,), (M,), (M,) in its frame."""
        x, y, z = local
        a, b, c = self.half
        if self.kind == "blade":
            return Blade(c, a, b).distance(z, x, y)
        z = z - c
        if self.kind == "ellipsoid":
            size = ((x / a).square() + (y / b).square() + (z / c).square()).sqrt()
            return (size - 1) * min(a, b, c)
        rounding = min(a, b) if self.kind == "capsule" else 0.35 * min(a, b)
        return rounded_box(x, y, z, (a, b, c), rounding)

    def deformed(self, local: Sequence[Tensor], speed: float, time: float) -> Sequence[Tensor]:
        """Points of its frame at ``time``: spun, squashed, twisted, then bent."""
        x, y, z = local
        x, y = turn(x, y, self.spin(speed, time))
        if self.rigid:
            return x, y, z
        factor = math.exp(self.squash(speed, time))
        x = x / math.sqrt(factor)
        y = y / math.sqrt(factor)
        z = z * factor
        x, y = turn(x, y, self.twist(speed, time) * (z / self.along).clamp(0, 1))
        z, x = turn(z, x, self.bend(speed, time) * self._ramp(x, y, z))
        return x, y, z

    def undeformed(self, local: Sequence[Tensor], speed: float, time: float) -> Sequence[Tensor]:
        """The exact inverse of :meth:`deformed`."""
        x, y, z = local
        if not self.rigid:
            z, x = turn(z, x, -self.bend(speed, time) * self._ramp(x, y, z))
            x, y = turn(x, y, -self.twist(speed, time) * (z / self.along).clamp(0, 1))
            factor = math.exp(self.squash(speed, time))
            x = x * math.sqrt(factor)
            y = y * math.sqrt(factor)
            z = z / factor
        x, y = turn(x, y, -self.spin(speed, time))
        return x, y, z

    def distance_at(self, local: Sequence[Tensor], speed: float, time: float) -> Tensor:
        """Lower bound (M,) at ``time`` of points in its frame, which moves with it."""
        if self.rigid:
            return self.distance(local)
        factor = math.exp(self.squash(speed, time))
        longest = max(factor, 1 / math.sqrt(factor))
        radius = self.reach * longest
        bent = stretch(BEND_SHEAR * abs(self.bend(speed, time)))
        shear = abs(self.twist(speed, time)) * (radius + SHELL) / self.along
        slope = bent * stretch(shear) * max(1 / factor, math.sqrt(factor))
        inside = self.distance(self.undeformed(local, speed, time)) / slope
        away = length(torch.stack(list(local), dim=-1)) - radius
        return torch.where(away > SHELL, away, torch.maximum(inside, away))

    def _ramp(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        u = ((x * x + y * y + z * z).sqrt() / self.along).clamp(0, 1)
        return u * u * (3 - 2 * u)


@dataclass(frozen=True, eq=False)
class Assembled:
    """A :class:`~devrf.scenes.procedural.solids.Shape` made of K parts.

    Attributes:
        parts: its parts.
        speed: scales all motion.
    """

    parts: tuple[Part, ...]
    speed: float = 1.0

    @cached_property
    def _painted(self) -> PaintedParts:
        axes = torch.stack([part.axes for part in self.parts])
        base = torch.stack([part.base for part in self.parts])
        return PaintedParts([part.paint for part in self.parts], base, axes)

    def distance(self, points: Tensor, time: float) -> Tensor:
        """The nearest part's lower bound (M,)."""
        return self.distances(points, time).amin(dim=0)

    def distances(self, points: Tensor, time: float) -> Tensor:
        """Lower bound (K, M) of the distance to each part."""
        frames = zip(self.parts, _frames(self, time), strict=True)
        return torch.stack(
            [part.distance_at(_into(frame, points), self.speed, time) for part, frame in frames]
        )

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest part's material."""
        part = self.distances(points, time).argmin(dim=0)
        canonical = torch.zeros_like(points)
        for k, (own, frame) in enumerate(zip(self.parts, _frames(self, time), strict=True)):
            own_points = part == k
            local = own.undeformed(_into(frame, points[own_points]), self.speed, time)
            canonical[own_points] = _out_of(_frames(self, 0.0)[k], local)
        return Material(canonical, part)

    def forward(self, material: Material, time: float) -> Tensor:
        """Each point deformed in its part's frame, which then moves."""
        points = torch.zeros_like(material.canonical)
        for k, (own, frame) in enumerate(zip(self.parts, _frames(self, time), strict=True)):
            own_points = material.part == k
            local = _into(_frames(self, 0.0)[k], material.canonical[own_points])
            points[own_points] = _out_of(frame, own.deformed(local, self.speed, time))
        return points

    def color(self, material: Material) -> Tensor:
        """The parts' paints."""
        return self._painted.color(material)

    def outline(self) -> Material:
        """A grid of points over the box around each part, in its own frame."""
        half = torch.tensor([part.half for part in self.parts])
        return self._painted.outline(half, half * torch.tensor([0.0, 0.0, 1.0]))


@lru_cache(maxsize=256)
def _frames(body: Assembled, time: float) -> tuple[Tensor, ...]:
    """World ← part (3, 4) float64 of each part at ``time``."""
    links: list[Tensor] = []
    for part in body.parts:
        link = torch.eye(4, dtype=torch.float64)
        link[:3, :3] = rotation(part.hinge, part.swing(body.speed, time))
        slid = part.slide(body.speed, time) * part.axes[:, 2]
        link[:3, 3] = part.base - link[:3, :3] @ part.base + slid
        links.append(link if part.parent < 0 else links[part.parent] @ link)
    canonical = [torch.cat([part.axes, part.base[:, None]], dim=1) for part in body.parts]
    corner = torch.tensor([[0.0, 0, 0, 1]], dtype=torch.float64)
    return tuple((m @ torch.cat([r, corner]))[:3] for m, r in zip(links, canonical, strict=True))


def _into(frame: Tensor, points: Tensor) -> tuple[Tensor, ...]:
    """x, y, z (M,) in a part's frame of world points (M, 3)."""
    frame = frame.to(points)
    return ((points - frame[:, 3]) @ frame[:, :3]).unbind(-1)


def _out_of(frame: Tensor, local: Sequence[Tensor]) -> Tensor:
    """World points (M, 3) of x, y, z (M,) in a part's frame."""
    frame = frame.to(local[0])
    return torch.stack(list(local), dim=-1) @ frame[:, :3].T + frame[:, 3]
