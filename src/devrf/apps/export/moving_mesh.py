"""One mesh, with one topology, that moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.apps.export.surface import Surface
from devrf.geometry.space import Space

ForwardMap = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class MovingMesh:
    """A mesh at T times.

    Attributes:
        times: T times in [0, 1], ascending.
        vertices: (T, V, 3) float32, in the capture's world.
        faces: (F, 3) int64, counter-clockwise from outside.
        colors: (V, 3) RGB in [0, 1], sRGB.
    """

    times: tuple[float, ...]
    vertices: Tensor
    faces: Tensor
    colors: Tensor


def carried(
    surface: Surface,
    forward: Callable[[float], ForwardMap],
    space: Space,
    times: Sequence[float],
    device: torch.device,
) -> MovingMesh:
    """A surface at rest, carried through time: each canonical vertex q goes to x(q, t).

    Args:
        surface: at rest, in the fields' space.
        forward: time → q → x(q, t), in the fields' space.
        space: that space.
        times: in [0, 1], ascending.
        device: of the fields.
    """
    points = surface.points.to(device)
    moved = [space.to_world(forward(time)(points)).float().cpu() for time in times]
    return MovingMesh(tuple(times), torch.stack(moved), surface.faces, surface.colors)
