"""The plush: a soft toy that squashes, stretches, bends and twists (non-rigid motion).

World axes as a forward-facing scene has them: x right, y up, the cameras look along −z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from devrf.scenes.procedural.motion import Swing, ramp_shear, smooth_ramp, stretch, turn
from devrf.scenes.procedural.plush_parts import BASE, REACH, SOLIDS
from devrf.scenes.procedural.sdf import rounded_box
from devrf.scenes.procedural.shape import Material
from devrf.scenes.procedural.texture import PaintedParts

# Where along the distance from the toy's base bending and twisting build up: the feet stand
# still, ears and head turn as one.
_RAMP = (0.3, 1.15)
_SHEAR = ramp_shear(*_RAMP)
_BEND, _BEND_SWING = 0.30, Swing(3.0, -0.5)
_TWIST, _TWIST_SWING = 0.45, Swing(2.0, 0.0)
# Logarithm of the height's factor: it is squashed first and stretched later.
_SQUASH, _SQUASH_SWING = -0.12, Swing(4.0, 0.0)

# (3, K, 1) and (K, 1): they broadcast against coordinates (K, M).
_CENTER = torch.tensor([s.center for s in SOLIDS]).T[..., None]
_HALF = torch.tensor([s.half for s in SOLIDS]).T[..., None]
_ROUNDING = torch.tensor([s.rounding for s in SOLIDS])[:, None]


@dataclass(frozen=True)
class Plush:
    """A non-rigid :class:`~devrf.scenes.procedural.shape.Shape`; its parts are its solids.

    First its height is scaled by s about its base and its width and depth by 1/√s, which keeps
    the volume; then it turns about its base by angles that grow with the distance from it,
    which keep that distance. Both are undone exactly.

    Attributes:
        speed: scales squashing, bending and twisting.
    """

    speed: float = 1.0
    _paints: PaintedParts = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        center = torch.tensor([s.center for s in SOLIDS], dtype=torch.float64)
        origin = center + torch.tensor(BASE, dtype=torch.float64)
        upright = torch.eye(3, dtype=torch.float64).repeat(len(SOLIDS), 1, 1)
        paints = PaintedParts.of([s.paint for s in SOLIDS], upright, origin)
        object.__setattr__(self, "_paints", paints)

    def distance(self, points: Tensor, time: float) -> Tensor:
        """A lower bound (M,): distances at rest over the most that the motion stretches.

        Far from the toy it is the distance to a ball around it, which is cheap.
        """
        base = points.new_tensor(BASE)
        reach = REACH * self._longest(time)
        ball: Tensor = (points - base).norm(dim=-1) - reach
        near = (ball < 0.1 * reach).nonzero().squeeze(-1)
        local = self._at_rest(points[near] - base, time)
        ball[near] = self._slack(time) * self._distances(local).amin(dim=0)
        return ball

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest solid's material."""
        base = points.new_tensor(BASE)
        local = self._at_rest(points - base, time)
        return Material(local + base, self._distances(local).argmin(dim=0))

    def forward(self, material: Material, time: float) -> Tensor:
        """Squash, then bend and twist, all about the base."""
        base = material.rest.new_tensor(BASE)
        height = self._height(time)
        x, y, z = (material.rest - base).unbind(-1)
        x, y, z = x / math.sqrt(height), y * height, z / math.sqrt(height)
        bend, twist = self._angles(time)
        ramp = smooth_ramp((x * x + y * y + z * z).sqrt(), *_RAMP)
        z, x = turn(z, x, twist * ramp)
        x, y = turn(x, y, bend * ramp)
        return torch.stack([x, y, z], dim=-1) + base

    def color(self, material: Material) -> Tensor:
        """The solids' paints."""
        return self._paints.color(material.rest, material.part)

    def outline(self) -> Material:
        """A grid of points over the box around each solid."""
        steps = torch.linspace(-1, 1, 7)
        cube = torch.cartesian_prod(steps, steps, steps)
        box = (_CENTER + cube.T[:, None] * _HALF).permute(1, 2, 0)
        part = torch.arange(len(SOLIDS))[:, None].expand(-1, len(cube))
        rest = box.reshape(-1, 3) + torch.tensor(BASE)
        return Material(rest, part.reshape(-1))

    def _height(self, time: float) -> float:
        """s: how high the toy is, relative to rest."""
        return math.exp(self.speed * _SQUASH * _SQUASH_SWING(time))

    def _longest(self, time: float) -> float:
        """The most that squashing lengthens anything."""
        height = self._height(time)
        return max(height, 1 / math.sqrt(height))

    def _angles(self, time: float) -> tuple[float, float]:
        """Full bending and twisting angles at ``time``, radians."""
        bend = self.speed * _BEND * _BEND_SWING(time)
        return bend, self.speed * _TWIST * _TWIST_SWING(time)

    def _slack(self, time: float) -> float:
        """A distance at rest times this is safe at ``time``."""
        bend, twist = self._angles(time)
        height = self._height(time)
        # Back to rest, lengths grow by no more than 1/s up and √s across.
        return 1 / (stretch((abs(bend) + abs(twist)) * _SHEAR) * max(1 / height, math.sqrt(height)))

    def _at_rest(self, local: Tensor, time: float) -> Tensor:
        """Rest positions (M, 3) of points (M, 3), both relative to the base."""
        x, y, z = local.unbind(-1)
        bend, twist = self._angles(time)
        height = self._height(time)
        ramp = smooth_ramp((x * x + y * y + z * z).sqrt(), *_RAMP)
        x, y = turn(x, y, -bend * ramp)
        z, x = turn(z, x, -twist * ramp)
        wide = math.sqrt(height)
        return torch.stack([x * wide, y / height, z * wide], dim=-1)

    def _distances(self, local: Tensor) -> Tensor:
        """Distance (K, M) at rest to each solid, of points (M, 3) relative to the base."""
        x, y, z = local.T[:, None] - _CENTER.to(local)
        width, height, depth = _HALF.to(local)
        return rounded_box(x, y, z, (width, height, depth), _ROUNDING.to(local))
