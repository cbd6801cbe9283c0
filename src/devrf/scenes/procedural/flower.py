"""The flower: a stem that bends and twists, petals that curl open (non-rigid motion)."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from devrf.scenes.procedural import flower_parts as parts
from devrf.scenes.procedural.flower_parts import LEAVES, WHORLS
from devrf.scenes.procedural.motion import (
    Swing,
    ramp_shear,
    rotation,
    smooth_ramp,
    stretch,
    turn,
)
from devrf.scenes.procedural.sdf import blade, rounded_box, rounded_cylinder, sphere
from devrf.scenes.procedural.shape import Material
from devrf.scenes.procedural.texture import PaintedParts
from devrf.scenes.procedural.whorl import PetalWhorl

# Where along the distance from the stem's base bending and twisting build up: nothing below,
# one rigid turn above, which leaves the blossom undistorted.
_RAMP = (0.05, 0.85)
_BEND, _BEND_SWING = 0.66, Swing(1.2, -0.1)
_TWIST, _TWIST_SWING = 0.6, Swing(1.4, -0.4)
_OPENING_SWING = Swing(1.7, -0.5)
_SHEAR = ramp_shear(*_RAMP)

_POT, _STEM, _HEART, _FIRST_LEAF = 0, 1, 2, 3
_FIRST_PETAL = _FIRST_LEAF + len(LEAVES)


@dataclass(frozen=True)
class Flower:
    """A non-rigid :class:`~devrf.scenes.procedural.shape.Shape`; parts: pot, stem, … petals.

    A petal first curls about its hinge, by an angle that grows with the distance from it; then
    all but the pot turns about the stem's base, by angles that grow with the distance from it.
    Both keep that distance, so both are undone exactly.

    Attributes:
        speed: scales bending, twisting and curling.
    """

    speed: float = 1.0
    _whorls: tuple[PetalWhorl, ...] = field(init=False, repr=False, compare=False)
    _paints: PaintedParts = field(init=False, repr=False, compare=False)
    _leaf_frames: tuple[tuple[Tensor, Tensor], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        whorls, first = [], _FIRST_PETAL
        for whorl in WHORLS:
            whorls.append(PetalWhorl(whorl, first))
            first += whorl.count
        leaves = tuple(_leaf_frame(leaf) for leaf in LEAVES)
        object.__setattr__(self, "_whorls", tuple(whorls))
        object.__setattr__(self, "_leaf_frames", leaves)
        object.__setattr__(self, "_paints", _paints(leaves, whorls))

    def distance(self, points: Tensor, time: float) -> Tensor:
        """A lower bound (M,): distances at rest over the most that the motion stretches."""
        return self._distances(points, self._unbent(points, time), time).amin(dim=0)

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest part's material: unbent, and for a petal uncurled."""
        rest = self._unbent(points, time)
        kind = self._distances(points, rest, time).argmin(dim=0)
        part = kind.clone()
        rest = torch.where((kind == _POT)[:, None], points, rest)
        for k, whorl in enumerate(self._whorls):
            own = kind == _FIRST_PETAL + k
            petal = whorl.nearest(rest)
            flat = whorl.uncurled(rest, petal, self._opening(time))
            part = torch.where(own, whorl.first_part + petal, part)
            rest = torch.where(own[:, None], flat, rest)
        return Material(rest, part)

    def forward(self, material: Material, time: float) -> Tensor:
        """Curl, then bend and twist; the pot stays."""
        points = material.rest
        for whorl in self._whorls:
            petal = material.part - whorl.first_part
            own = (petal >= 0) & (petal < whorl.count)
            curled = whorl.curled(points, petal.clamp(0, whorl.count - 1), self._opening(time))
            points = torch.where(own[:, None], curled, points)
        moved = self._bent(points, time)
        return torch.where((material.part == _POT)[:, None], material.rest, moved)

    def color(self, material: Material) -> Tensor:
        """The parts' paints."""
        return self._paints.color(material.rest, material.part)

    def outline(self) -> Material:
        """A grid of points over the box around each part, in its own frame."""
        steps = torch.linspace(-1, 1, 7)
        cube = torch.cartesian_prod(steps, steps, steps)
        stem = (parts.HEAD - parts.BASE) / 2
        columns = (
            (parts.POT_RADIUS, parts.POT_HALF_HEIGHT),
            (parts.STEM_RADIUS, stem),
            (parts.HEART, parts.HEART),
        )
        blades = [(leaf.half_length, leaf.half_width, parts.LEAF_THICKNESS) for leaf in LEAVES]
        for whorl in WHORLS:
            blades += [(whorl.half_length, whorl.half_width, whorl.thickness)] * whorl.count
        local = [cube * torch.tensor([radius, radius, half]) for radius, half in columns]
        # A blade's frame starts at its hinge, so its box lies at x = 0 … 2 · half_length.
        local += [
            cube * torch.tensor([a + t, b + t, t]) + torch.tensor([a, 0.0, 0.0])
            for a, b, t in blades
        ]
        rotations, origins = self._paints.rotation.float(), self._paints.origin.float()
        rest = torch.einsum("kij,kmj->kmi", rotations, torch.stack(local)) + origins[:, None]
        part = torch.arange(len(local))[:, None].expand(-1, len(cube))
        return Material(rest.reshape(-1, 3), part.reshape(-1))

    def _angles(self, time: float) -> tuple[float, float]:
        """Full bending and twisting angles at ``time``."""
        bend = self.speed * _BEND * _BEND_SWING(time)
        return bend, self.speed * _TWIST * _TWIST_SWING(time)

    def _opening(self, time: float) -> float:
        """How far the petals have opened: 0 at rest, about ``speed`` at the end."""
        return self.speed * _OPENING_SWING(time)

    def _bent(self, points: Tensor, time: float) -> Tensor:
        x, y, z = _about_base(points)
        bend, twist = self._angles(time)
        ramp = smooth_ramp((x * x + y * y + z * z).sqrt(), *_RAMP)
        x, y = turn(x, y, twist * ramp)
        z, x = turn(z, x, bend * ramp)
        return torch.stack([x, y, z + parts.BASE], dim=-1)

    def _unbent(self, points: Tensor, time: float) -> Tensor:
        x, y, z = _about_base(points)
        bend, twist = self._angles(time)
        ramp = smooth_ramp((x * x + y * y + z * z).sqrt(), *_RAMP)
        z, x = turn(z, x, -bend * ramp)
        x, y = turn(x, y, -twist * ramp)
        return torch.stack([x, y, z + parts.BASE], dim=-1)

    def _distances(self, points: Tensor, unbent: Tensor, time: float) -> Tensor:
        """(kinds, M) safe distances: pot, stem, heart, the leaves, the whorls."""
        pot = rounded_cylinder(
            points[:, 0],
            points[:, 1],
            points[:, 2] - parts.POT_CENTER,
            parts.POT_RADIUS,
            parts.POT_HALF_HEIGHT,
            parts.POT_ROUNDING,
        )
        x, y, z = unbent.unbind(-1)
        r, length = parts.STEM_RADIUS, (parts.HEAD - parts.BASE) / 2
        stem = rounded_box(x, y, z - (parts.HEAD + parts.BASE) / 2, (r, r, length), r)
        heart = sphere(x, y, z - parts.HEAD, parts.HEART)
        leaves = []
        for leaf, (axes, origin) in zip(LEAVES, self._leaf_frames, strict=True):
            u, v, w = ((unbent - origin.to(unbent)) @ axes.to(unbent)).unbind(-1)
            leaves.append(
                blade(
                    u - leaf.half_length,
                    v,
                    w,
                    leaf.half_length,
                    leaf.half_width,
                    parts.LEAF_THICKNESS,
                )
            )
        opening = self._opening(time)
        petals = [whorl.distance(unbent, opening) for whorl in self._whorls]
        bending = torch.stack([stem, heart, *leaves, *petals])
        return torch.cat([pot[None], self._before_bending(bending, unbent, time)])

    def _before_bending(self, distances: Tensor, unbent: Tensor, time: float) -> Tensor:
        """Safe distances (kinds, M) in the world for the distances (kinds, M) unbent."""
        bend, twist = self._angles(time)
        slack = 1 / stretch((abs(bend) + abs(twist)) * _SHEAR)
        # Beyond the ramp the motion is rigid: up to the ramp's end, distances hold as they are.
        x, y, z = _about_base(unbent)
        rigid = (x * x + y * y + z * z).sqrt() - _RAMP[1]
        return torch.maximum(slack * distances, torch.minimum(distances, rigid))


def _about_base(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    x, y, z = points.unbind(-1)
    return x, y, z - parts.BASE


def _leaf_frame(leaf: parts.Leaf) -> tuple[Tensor, Tensor]:
    """Axes (3, 3) as columns (along, across, normal) and origin (3,) of a leaf, float64."""
    axes = rotation((0, 0, 1), leaf.azimuth) @ rotation((0, 1, 0), -leaf.elevation)
    return axes, torch.tensor([0, 0, leaf.height], dtype=torch.float64)


def _paints(leaves: tuple[tuple[Tensor, Tensor], ...], whorls: list[PetalWhorl]) -> PaintedParts:
    """The paints of all parts in the order of their numbers."""
    upright = torch.eye(3, dtype=torch.float64)
    middle = (parts.HEAD + parts.BASE) / 2
    heights = (parts.POT_CENTER, middle, parts.HEAD)
    frames = [(upright, torch.tensor([0, 0, h], dtype=torch.float64)) for h in heights]
    frames += list(leaves)
    paints = [parts.POT_PAINT, parts.STEM_PAINT, parts.HEART_PAINT]
    paints += [leaf.paint for leaf in LEAVES]
    for whorl in whorls:
        frames += [whorl.frame(k) for k in range(whorl.count)]
        paints += [whorl.whorl.paints[k % 2] for k in range(whorl.count)]
    return PaintedParts.of(
        paints, torch.stack([f[0] for f in frames]), torch.stack([f[1] for f in frames])
    )
