"""The surface of a field at rest: where the opacity of a voxel reaches a threshold."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.space import Space
from devrf.rendering.surface_field import SurfaceField

# Points at which a field is asked at once.
CHUNK = 2**18
# A voxel with less optical depth counts as having so much: the logarithm ends here.
LEAST = 1e-6
# Rays of each camera, along each side of its image, that say where empty space begins.
ENTRIES = 16

Mesh = tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]


def isosurface(field: SurfaceField, outside: Tensor, threshold: float, side: int | None) -> Mesh:
    """Marching cubes on a field, as if solid wherever no empty way leads from ``outside``.

    Density is learned where images show it: behind a surface it often falls to nothing again. A
    second surface there would be seen by no camera.

    What is interpolated between grid points is s = log(eᵗ − 1), t the optical depth: of a density
    softplus(v + b) that is v + b, which DeVRF interpolates, too (docs/method.md#density).

    Args:
        field: at rest.
        outside: (K, 3) points of the fields' space that cameras see through.
        threshold: opacity of one voxel on the surface, in (0, 1).
        side: grid points along the box's longest edge; None: those of the field.

    Returns:
        vertices (V, 3) in the fields' space, and faces (F, 3), counter-clockwise from outside if
        that space is right-handed.

    Raises:
        DevrfError: no point of the field has that opacity, or all have.
    """
    from skimage import measure  # an extra

    box = field.box
    shape = field.shape if side is None else _shape(box, side)
    depth = _sampled(field, shape)
    level = _logit(torch.tensor(-math.log1p(-threshold))).item()
    values = _logit(depth).numpy()
    empty = values < level
    if empty.all():
        most = -math.expm1(-float(depth.max()))
        raise DevrfError(
            f"export.threshold: the field is empty: no voxel has the opacity {threshold:g}, the "
            f"most is {most:.2g}; give a lower threshold, or learn for longer"
        )
    if not empty.any():
        raise DevrfError(
            f"export.threshold: all of the field has the opacity {threshold:g}; give a higher one"
        )
    hidden = empty & ~_reached(empty, box, outside)
    values[hidden] = 2 * abs(level) + values.max()
    vertices, faces, _, _ = measure.marching_cubes(values, level, gradient_direction="ascent")
    low, size = np.array(box.low), np.array(box.size)
    points = low + vertices * (size / (np.array(shape) - 1))
    return points.astype(np.float32), faces.astype(np.int64)


def entries(cameras: Cameras, space: Space, box: Box, limits: tuple[float, float]) -> Tensor:
    """Points (K, 3) in the fields' space at which rays of the cameras begin to be sampled.

    Args:
        cameras: in world units, on the host.
        space: the space of the fields.
        box: what holds the scene, in it.
        limits: distances before and behind which nothing is sampled, in it.
    """
    cameras = cameras.resized(ENTRIES, ENTRIES)
    found = []
    for camera in range(len(cameras)):
        rays = space.rays(cameras.image_rays(camera))
        entry, leave = box.crossing(rays, *limits)
        met = (entry < leave).nonzero()[:, 0]
        found.append(rays.at(met, entry[met]))
    return torch.cat(found)


def _shape(box: Box, side: int) -> tuple[int, int, int]:
    x, y, z = (max(2, round(edge / box.longest * (side - 1)) + 1) for edge in box.size)
    return x, y, z


def _sampled(field: SurfaceField, shape: tuple[int, int, int]) -> Tensor:
    """Optical depth (X, Y, Z) at a grid's points, on the host."""
    points = field.box.grid_points(shape, torch.empty(0)).view(-1, 3)
    return torch.cat([field.optical_depth(part).cpu() for part in torch.split(points, CHUNK)]).view(
        shape
    )


def _logit(depth: Tensor) -> Tensor:
    depth = depth.clamp(min=LEAST)
    return depth + torch.log(-torch.expm1(-depth))


def _reached(empty: npt.NDArray[np.bool_], box: Box, outside: Tensor) -> npt.NDArray[np.bool_]:
    """Which of the empty cells are connected, face to face, with a point of ``outside``."""
    from skimage import measure

    labels = measure.label(empty, connectivity=1)
    shape = torch.tensor(empty.shape)
    cells = box.to_grid(outside, empty.shape).round().long()
    inside = ((cells >= 0) & (cells < shape)).all(dim=1)
    begun = np.unique(labels[tuple(cells[inside].t().numpy())])
    found: npt.NDArray[np.bool_] = np.isin(labels, begun[begun > 0])
    # Where all cameras stand in fog there is nothing to go by.
    return found if found.any() else empty
