"""A furnished room around a shape: every ray from inside it meets something."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.procedural.backdrop import WAVES, WEAVE, mural
from devrf.scenes.procedural.shape import Material
from devrf.scenes.procedural.solids import Solid, SolidTable, Xyz
from devrf.scenes.procedural.texture import Paint, Rgb

# Half width and depth of the room, and its height above the floor, world units.
_HALF, _HEIGHT = (6.0, 5.0), 5.2
# Radius of a ball about the origin that holds the room.
REACH = 10.0
# Fine paint: so much of it is the mural, its waves so much longer than on the wall it was made for.
_MURAL, _LONGER = 0.6, 1.6
# Rays that creep past furniture have to reach a wall.
STEPS = 400

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
    Paint(WOOD, DARK, (1.1, 0.8, 0), 0.1),
    Paint(LINEN, MIST, (2.4, 2.4, 0), 0.2),
    Paint(PLASTER, SAGE, (0, 1.6, 1.6), 0.1),
    Paint(MIST, SLATE, (0, 1.5, 0), 0.3),
    Paint(LINEN, BRICK, (1.8, 0, 1.1), 0.3),
    Paint(PLASTER, OCHRE, (2.1, 0, 0), 0.2),
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

    @property
    def parts(self) -> int:
        """How many there are."""
        return len(_SURFACES) + len(_FURNITURE)

    def distances(self, points: Tensor) -> Tensor:
        """Distances (K, M) to floor, ceiling, walls and furniture."""
        x, y, z = points.unbind(-1)
        z = z - self.floor
        width, depth = _HALF
        faces = torch.stack([z, _HEIGHT - z, x + width, width - x, y + depth, depth - y])
        lifted = torch.stack([x, y, z])[:, None] - _TABLE.center.to(points).T[..., None]
        return torch.cat([faces, _TABLE.distances(*lifted)])

    def color(self, material: Material) -> Tensor:
        """The paper or the paint (M, 3)."""
        lifted = material.rest - material.rest.new_tensor([0.0, 0.0, self.floor])
        furniture = (material.part - len(_SURFACES)).clamp(0, len(_FURNITURE) - 1)
        painted = _TABLE.painted.color(Material(lifted, furniture))
        surface = _papered(lifted, material.part.clamp(max=len(_SURFACES) - 1))
        color = torch.where((material.part < len(_SURFACES))[:, None], surface, painted)
        if not self.weave:
            return color
        return color.lerp(mural(material.rest / _LONGER, (*WAVES, *WEAVE)), _MURAL)


def _papered(points: Tensor, surface: Tensor) -> Tensor:
    """Colours (M, 3) of points on floor, ceiling and walls, shaded so that no place is another's.

    A slow wave of brightness along each axis makes repeats of the pattern differ.
    """

    def rows(values: list[tuple[float, ...]]) -> Tensor:
        return points.new_tensor(values)[surface]

    wave = rows([tuple(2 * math.pi / q if q else 0.0 for q in p.periods) for p in _SURFACES])
    pattern = (points * wave).cos().prod(dim=-1)
    threshold = rows([(p.threshold,) for p in _SURFACES])[:, 0]
    share = (4 * (pattern - threshold)).sigmoid()[:, None]
    mixed = torch.lerp(
        rows([p.base for p in _SURFACES]), rows([p.accent for p in _SURFACES]), share
    )
    slow = (points * points.new_tensor([0.55, 0.71, 0.83]) + 0.4).cos().mean(dim=-1)
    return mixed * (0.82 + 0.18 * slow)[:, None]
