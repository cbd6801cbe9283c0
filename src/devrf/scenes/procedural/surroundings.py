"""A moving shape in static surroundings: a room, or a wall behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from devrf.scenes.procedural.solids import (
    Material,
    Paint,
    PaintedParts,
    Rgb,
    Shape,
    Solid,
    SolidTable,
    Xyz,
    rounded_box,
)


@dataclass(frozen=True)
class Surrounded:
    """A :class:`~devrf.scenes.procedural.solids.Shape` in static surroundings.

    The first parts are those of the surroundings; the shape's own follow. ``reach`` is the radius
    of a ball about ``center`` that holds the moving shape at all times, world units.
    """

    shape: Shape
    surroundings: Backdrop | Room
    reach: float
    center: Xyz = (0.0, 0.0, 0.0)

    def distance(self, points: Tensor, time: float) -> Tensor:
        """The smaller of the shape's distance bound and the surroundings' (M,)."""
        static = self.surroundings.distances(points).amin(dim=0)
        return torch.minimum(static, self._bound(points, time))

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest surface's material; that of the surroundings does not move."""
        static, part = self.surroundings.distances(points).min(dim=0)
        own = self.shape.material(points, time)
        nearer = self._bound(points, time) < static
        return Material(
            torch.where(nearer[:, None], own.canonical, points),
            torch.where(nearer, own.part + self.surroundings.parts, part),
        )

    def forward(self, material: Material, time: float) -> Tensor:
        """The shape's motion; the surroundings stay."""
        moved = self.shape.forward(self._of_shape(material), time)
        return torch.where(self._is_shape(material), moved, material.canonical)

    def color(self, material: Material) -> Tensor:
        """The shape's paint, or that of its surroundings."""
        own = self.shape.color(self._of_shape(material))
        return torch.where(self._is_shape(material), own, self.surroundings.color(material))

    def _bound(self, points: Tensor, time: float) -> Tensor:
        """The shape's distance bound (M,); far from it that to the ball around it."""
        ball: Tensor = (points - points.new_tensor(self.center)).norm(dim=-1) - self.reach
        near = (ball < 0.1 * self.reach).nonzero().squeeze(-1)
        ball[near] = self.shape.distance(points[near], time)
        return ball

    def _is_shape(self, material: Material) -> Tensor:
        """Mask (M, 1) of the shape's material."""
        return (material.part >= self.surroundings.parts)[:, None]

    def _of_shape(self, material: Material) -> Material:
        """The material with the shape's own part numbers, where it is of the shape."""
        return Material(material.canonical, (material.part - self.surroundings.parts).clamp_min(0))


# The wall is the plane z = WALL, the floor the plane y = FLOOR; world units, y up.
WALL = -4.6
FLOOR = -1.15
# The pedestal's centre, outer half edges and rounding.
_CENTER = (0.0, (FLOOR - 0.72) / 2, -2.6)
_HALF = (0.56, (-0.72 - FLOOR) / 2, 0.44)
_ROUNDING = 0.04

# The number of the part: the wall is 0, the floor 1.
_PEDESTAL = 2

Wave = tuple[Xyz, float, Rgb]

# Waves of the paint: direction (x, y, z) times angular frequency in radians per world unit, a
# phase, and its shares in red, green and blue. No two wavelengths have a common multiple within the
# picture, so that no place looks like another.
WAVES = (
    ((1.1, 0.7, 0.9), 0.3, (0.7, 0.3, -0.1)),
    ((-1.2, 2.3, -1.7), 1.1, (-0.1, 0.5, 0.4)),
    ((3.9, -1.9, 1.3), 2.0, (0.6, 0.5, 0.7)),
    ((1.3, 4.7, 3.3), 0.7, (0.5, 0.6, 0.3)),
    ((-5.3, -3.9, 4.1), 2.9, (0.6, 0.6, 0.6)),
    ((6.7, 4.1, -2.9), 4.2, (0.5, 0.4, 0.5)),
)
# A weave over the clouds, of wavelengths from 0.11 to 0.27 world units: on the wall five to
# twelve pixels of an image that is 240 pixels wide.
WEAVE = (
    ((23.0, 9.1, 5.3), 0.9, (0.9, 0.5, 0.3)),
    ((-13.7, 29.3, 17.9), 2.2, (0.4, 0.9, 0.6)),
    ((41.3, -7.7, 21.1), 3.7, (0.8, 0.7, 0.8)),
    ((11.9, 37.1, -43.7), 5.1, (0.6, 0.8, 0.9)),
    ((-33.1, -43.3, 31.7), 1.6, (0.7, 0.6, 0.5)),
)
# The paint's darkest and lightest colour, paler than the subject before it.
_DARKEST = (0.42, 0.45, 0.52)
_LIGHTEST = (0.86, 0.88, 0.90)


@dataclass(frozen=True)
class Backdrop:
    """Wall, floor and pedestal, in that order.

    Attributes:
        weave: whether the paint is fine, for images of about 240 pixels or more; else soft.
        pedestal: whether there is one.
        contrast: of the paint, about its middle; with a low one the subject has more features.
    """

    weave: bool = False
    pedestal: bool = True
    contrast: float = 1.0

    @property
    def parts(self) -> int:
        """Number of parts."""
        return _PEDESTAL + self.pedestal

    def distances(self, points: Tensor) -> Tensor:
        """Distances (K, M) to wall, floor and pedestal."""
        x, y, z = points.unbind(-1)
        faces = [z - WALL, y - FLOOR]
        if self.pedestal:
            a, b, c = _CENTER
            faces.append(rounded_box(x - a, y - b, z - c, _HALF, _ROUNDING))
        return torch.stack(faces)

    def color(self, material: Material) -> Tensor:
        """The paint (M, 3): the pedestal stands out from the floor."""
        painted = mural(material.canonical, (*WAVES, *WEAVE) if self.weave else WAVES)
        middle = (painted.new_tensor(_DARKEST) + painted.new_tensor(_LIGHTEST)) / 2
        painted = torch.lerp(middle, painted, self.contrast)
        return torch.where((material.part == _PEDESTAL)[:, None], 0.5 * painted, painted)


def mural(points: Tensor, waves: Sequence[Wave]) -> Tensor:
    """Clouds of colour (M, 3), painted in space: the sum of ``waves``, then bounded."""
    wave = points.new_tensor([w for w, _, _ in waves])
    phase = points.new_tensor([p for _, p, _ in waves])
    mixed = (points @ wave.T + phase).cos() @ points.new_tensor([c for _, _, c in waves])
    dark = points.new_tensor(_DARKEST)
    light = points.new_tensor(_LIGHTEST)
    return torch.lerp(dark, light, torch.sigmoid(1.5 * mixed))


# Half width and depth of the room, and its height above the floor, world units.
_ROOM_HALF = (6.0, 5.0)
_HEIGHT = 5.2
# Radius of a ball about the origin that holds the room.
REACH = 10.0
# The share of the mural in fine paint, and how much longer its waves are than on the wall.
_MURAL = 0.6
_LONGER = 1.6

WOOD: Rgb = (0.62, 0.43, 0.26)
DARK: Rgb = (0.33, 0.22, 0.15)
PLASTER: Rgb = (0.80, 0.76, 0.66)
SAGE: Rgb = (0.52, 0.62, 0.50)
BRICK: Rgb = (0.66, 0.34, 0.26)
LINEN: Rgb = (0.90, 0.86, 0.78)
SLATE: Rgb = (0.34, 0.40, 0.47)
OCHRE: Rgb = (0.80, 0.62, 0.27)
ROSE: Rgb = (0.74, 0.45, 0.45)
MIST: Rgb = (0.70, 0.78, 0.84)

# Floor, ceiling, and the walls at −x, +x, −y, +y: the finest pattern is some five pixels wide in
# images of 96.
_SURFACES = (
    Paint(WOOD, DARK, (1.1, 0.8, 0), 0.1, 4),
    Paint(LINEN, MIST, (2.4, 2.4, 0), 0.2, 4),
    Paint(PLASTER, SAGE, (0, 1.6, 1.6), 0.1, 4),
    Paint(MIST, SLATE, (0, 1.5, 0), 0.3, 4),
    Paint(LINEN, BRICK, (1.8, 0, 1.1), 0.3, 4),
    Paint(PLASTER, OCHRE, (2.1, 0, 0), 0.2, 4),
)


def _box(
    center: Xyz, half: Xyz, base: Rgb, accent: Rgb, period: float, edge: float = 0.05
) -> Solid:
    return Solid(center, half, edge, Paint(base, accent, (period,) * 3, 0.1))


# Heights are above the floor: a table with a bowl, a sofa, a shelf, a chest, a lamp, two pictures.
_FURNITURE = (
    _box((4.6, 2.2, 0.95), (0.8, 1.3, 0.08), OCHRE, DARK, 1.2),
    _box((4.1, 1.2, 0.45), (0.1, 0.1, 0.45), DARK, DARK, 1.0),
    _box((4.1, 3.2, 0.45), (0.1, 0.1, 0.45), DARK, DARK, 1.0),
    _box((5.1, 1.2, 0.45), (0.1, 0.1, 0.45), DARK, DARK, 1.0),
    _box((5.1, 3.2, 0.45), (0.1, 0.1, 0.45), DARK, DARK, 1.0),
    _box((4.6, 2.4, 1.22), (0.32, 0.32, 0.2), ROSE, LINEN, 0.7, 0.18),
    _box((-4.9, -0.6, 0.4), (0.8, 1.9, 0.4), SLATE, MIST, 1.4, 0.15),
    _box((-5.55, -0.6, 1.0), (0.25, 1.9, 0.7), SLATE, ROSE, 1.4, 0.15),
    _box((-1.6, 4.65, 1.4), (1.3, 0.3, 1.4), WOOD, LINEN, 1.0),
    _box((2.2, -4.55, 0.6), (1.1, 0.4, 0.6), BRICK, OCHRE, 1.1),
    _box((-4.9, -3.9, 1.4), (0.09, 0.09, 1.4), DARK, DARK, 1.0),
    _box((-4.9, -3.9, 3.0), (0.45, 0.45, 0.4), LINEN, OCHRE, 0.9, 0.2),
    _box((5.95, -1.6, 2.6), (0.08, 1.2, 0.8), ROSE, SLATE, 1.3, 0.04),
    _box((-1.5, -4.95, 2.8), (1.0, 0.08, 0.7), SAGE, LINEN, 1.2, 0.04),
)
_TABLE = SolidTable(_FURNITURE)
# The pattern of floor, ceiling and walls starts at the world's origin.
_PAINTED = PaintedParts(
    [*_SURFACES, *(solid.paint for solid in _FURNITURE)],
    torch.cat([torch.zeros(len(_SURFACES), 3, dtype=torch.float64), _TABLE.center]),
)


@dataclass(frozen=True)
class Room:
    """Floor, ceiling, four walls and furniture, in that order.

    Attributes:
        floor: height of the floor, world units.
        weave: whether everything is finely painted, no place like another, as structure from
            motion needs it; for images of about 240 pixels or more.
    """

    floor: float
    weave: bool = False

    parts: ClassVar[int] = len(_SURFACES) + len(_FURNITURE)

    def distances(self, points: Tensor) -> Tensor:
        """Distances (K, M) to floor, ceiling, walls and furniture."""
        x, y, z = points.unbind(-1)
        z = z - self.floor
        width, depth = _ROOM_HALF
        faces = torch.stack([z, _HEIGHT - z, x + width, width - x, y + depth, depth - y])
        return torch.cat([faces, _TABLE.distances_of(torch.stack([x, y, z], dim=-1))])

    def color(self, material: Material) -> Tensor:
        """The paper or the paint (M, 3)."""
        lifted = material.canonical - material.canonical.new_tensor([0.0, 0.0, self.floor])
        painted = _PAINTED.color(Material(lifted, material.part.clamp(max=self.parts - 1)))
        # A slow wave of brightness along each axis makes repeats of the pattern differ.
        slow = (lifted * lifted.new_tensor([0.55, 0.71, 0.83]) + 0.4).cos().mean(dim=-1)
        papered = painted * (0.82 + 0.18 * slow)[:, None]
        color = torch.where((material.part < len(_SURFACES))[:, None], papered, painted)
        if not self.weave:
            return color
        return color.lerp(mural(material.canonical / _LONGER, (*WAVES, *WEAVE)), _MURAL)
