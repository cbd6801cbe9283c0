"""The flower: a stem that bends and twists, petals that curl open (non-rigid motion)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.procedural import flower_parts as parts
from devrf.scenes.procedural.blades import Leaf, Whorl
from devrf.scenes.procedural.flower_parts import LEAVES, WHORLS
from devrf.scenes.procedural.motion import Bending, Swing, length
from devrf.scenes.procedural.sdf import rounded_box, rounded_cylinder, sphere
from devrf.scenes.procedural.shape import Material
from devrf.scenes.procedural.texture import PaintedParts

# Where along the distance from the stem's base bending and twisting build up: nothing below,
# one rigid turn above, which leaves the blossom undistorted.
_RAMP = (0.05, 0.85)
_BENDING = Bending(_RAMP, ((0, 1, Swing(0.6, 1.4, -0.4)), (2, 0, Swing(0.66, 1.2, -0.1))))
_OPENING = Swing(1.0, 1.7, -0.5)
_BASE = (0.0, 0.0, parts.BASE)
_STEM_MIDDLE, _STEM_HALF = (parts.HEAD + parts.BASE) / 2, (parts.HEAD - parts.BASE) / 2


def _painted() -> PaintedParts:
    """The paints of all parts in the order of their numbers."""
    upright = torch.eye(3, dtype=torch.float64)
    heights = (parts.POT_CENTER, _STEM_MIDDLE, parts.HEAD)
    frames = [(upright, torch.tensor([0, 0, h], dtype=torch.float64)) for h in heights]
    frames += [leaf.frame() for leaf in LEAVES]
    paints = [parts.POT_PAINT, parts.STEM_PAINT, parts.HEART_PAINT]
    paints += [leaf.paint for leaf in LEAVES]
    for whorl in WHORLS:
        frames += [whorl.frame(k) for k in range(whorl.count)]
        paints += [whorl.paints[k % 2] for k in range(whorl.count)]
    axes, origins = zip(*frames, strict=True)
    return PaintedParts(paints, torch.stack(axes), torch.stack(origins))


_PAINTED = _painted()


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

    def distance(self, points: Tensor, time: float) -> Tensor:
        """A lower bound (M,): distances at rest over the most that the motion stretches."""
        return self._distances(points, self._unbent(points, time), time).amin(dim=0)

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest part's material: unbent, and for a petal uncurled."""
        rest = self._unbent(points, time)
        kind = self._distances(points, rest, time).argmin(dim=0)
        part = kind.clone()
        rest = torch.where((kind == parts.POT)[:, None], points, rest)
        opening = _OPENING(self.speed, time)
        for own_kind, whorl in enumerate(WHORLS, start=parts.FIRST_PETAL):
            own = kind == own_kind
            petal = whorl.nearest(rest)
            part = torch.where(own, whorl.first_part + petal, part)
            rest = torch.where(own[:, None], whorl.curled(rest, petal, -opening), rest)
        return Material(rest, part)

    def forward(self, material: Material, time: float) -> Tensor:
        """Curl, then bend and twist; the pot stays."""
        points = material.rest
        opening = _OPENING(self.speed, time)
        for whorl in WHORLS:
            petal = material.part - whorl.first_part
            own = (petal >= 0) & (petal < whorl.count)
            curled = whorl.curled(points, petal.clamp(0, whorl.count - 1), opening)
            points = torch.where(own[:, None], curled, points)
        base = points.new_tensor(_BASE)
        moved = _BENDING.bent(points - base, self.speed, time) + base
        return torch.where((material.part == parts.POT)[:, None], material.rest, moved)

    def color(self, material: Material) -> Tensor:
        """The parts' paints."""
        return _PAINTED.color(material)

    def outline(self) -> Material:
        """A grid of points over the box around each part, in its own frame."""
        half = [
            (parts.POT_RADIUS, parts.POT_RADIUS, parts.POT_HALF_HEIGHT),
            (parts.STEM_RADIUS, parts.STEM_RADIUS, _STEM_HALF),
            (parts.HEART, parts.HEART, parts.HEART),
        ]
        middle = [(0.0, 0.0, 0.0)] * len(half)
        blades: list[Leaf | Whorl] = [*LEAVES]
        for whorl in WHORLS:
            blades += [whorl] * whorl.count
        for blade in blades:
            a, b, t = blade.half_length, blade.half_width, blade.thickness
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
        pot = rounded_cylinder(
            x,
            y,
            z - parts.POT_CENTER,
            parts.POT_RADIUS,
            parts.POT_HALF_HEIGHT,
            parts.POT_ROUNDING,
        )
        x, y, z = unbent.unbind(-1)
        r = parts.STEM_RADIUS
        stem = rounded_box(x, y, z - _STEM_MIDDLE, (r, r, _STEM_HALF), r)
        heart = sphere(x, y, z - parts.HEAD, parts.HEART)
        leaves = []
        for number, leaf in enumerate(LEAVES, start=parts.FIRST_LEAF):
            axes, hinge = _PAINTED.rotation[number], _PAINTED.origin[number]
            leaves.append(leaf.distance((unbent - hinge.to(unbent)) @ axes.to(unbent)))
        petals = [whorl.distance(unbent, _OPENING(self.speed, time)) for whorl in WHORLS]
        bending = torch.stack([stem, heart, *leaves, *petals])
        # Beyond the ramp the motion is rigid: up to the ramp's end, distances hold as they are.
        rigid = length(unbent - unbent.new_tensor(_BASE)) - _RAMP[1]
        slack = 1 / _BENDING.stretch(self.speed, time)
        bending = torch.maximum(slack * bending, torch.minimum(bending, rigid))
        return torch.cat([pot[None], bending])
