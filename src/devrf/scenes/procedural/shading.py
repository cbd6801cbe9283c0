"""The colours of a shape's surface: its paint under ambient light and a fixed lamp."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.scenes.procedural.shape import Shape

# Towards the lamp, world space: fixed, so that shading changes as the shape turns.
_LAMP = (0.40, -0.55, 0.73)
# Half the span over which a normal is measured, world units: well above float32 rounding.
_NORMAL_STEP = 1e-3


def shaded(shape: Shape, points: Tensor, time: float, light: float) -> Tensor:
    """Colour (M, 3) of surface points: albedo, ambient light, and a wrapped diffuse lamp.

    Args:
        shape: whose surface it is.
        points: (M, 3) world units.
        time: in [0, 1].
        light: share of the lamp in the lighting, 0 (albedo alone) … 1.
    """
    albedo = shape.color(shape.material(points, time))
    if light == 0:
        return albedo
    lamp = torch.nn.functional.normalize(points.new_tensor(_LAMP), dim=0)
    # Wrapped: the side away from the lamp still varies, and no edge of shadow is drawn.
    lit = 0.5 + 0.5 * (_normals(shape, points, time) @ lamp)
    return albedo * (1 - light + light * lit)[:, None]


def _normals(shape: Shape, points: Tensor, time: float) -> Tensor:
    """Unit normals (M, 3): the distance's gradient from its values at a tetrahedron's corners."""
    corners = points.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    around = (points + _NORMAL_STEP * corners[:, None]).reshape(-1, 3)
    values = shape.distance(around, time).view(4, -1)
    return torch.nn.functional.normalize(values.T @ corners, dim=-1)
