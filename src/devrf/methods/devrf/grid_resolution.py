"""How fine a grid a scene asks for: by its space, its images, and the depth its views resolve."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.ndc import NormalizedDevice
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.scenes.scene import Scene

# Between two planes a point moves by so many pixels from one outermost static view to the other:
# less, and the views hardly tell two planes apart, while fog before the scene takes long to clear.
PIXELS_PER_PLANE = 4.0
FEWEST, MOST = 32, 256


def fitted_to(
    scene: Scene, schedule: CanonicalSchedule, architecture: Architecture
) -> tuple[CanonicalSchedule, Architecture]:
    """Schedule and architecture with the numbers that ``scene`` decides filled in.

    In NDC, where no number of planes is given it becomes the one that the static views resolve,
    and ``voxels_per_pixel`` becomes the ``side`` of a grid so fine (docs/method.md#forward-facing).
    In contracted space sides are longer, grids start coarser, and directions are learned later
    (docs/method.md#scene-contraction).

    Raises:
        DevrfError: the architecture has planes, and the scene is not in NDC.
    """
    space, planes = scene.space, architecture.planes
    if not isinstance(space, NormalizedDevice):
        if planes is not None:
            raise DevrfError(
                f"field.planes={planes}: planes are of forward-facing scenes, and this scene is "
                "not: give field=inward or field=small"
            )
        schedule = schedule.in_space(space)
        return schedule, architecture.in_space(space, schedule.side)
    if planes is None:
        planes = resolved_planes(scene.static.train.cameras.positions, space)
        architecture = replace(architecture, planes=planes)
    if schedule.voxels_per_pixel is not None:
        width, height, _ = scene.bounds.box.size
        # The reference image spans 2 × 2 units of NDC.
        across = width / 2 * space.width * schedule.voxels_per_pixel
        down = height / 2 * space.height * schedule.voxels_per_pixel
        schedule = replace(schedule, side=(across * down * planes) ** (1 / 3))
        architecture = replace(architecture, aspect=space.width / space.height)
    return schedule, architecture


def resolved_planes(positions: Tensor, space: NormalizedDevice) -> int:
    """How many planes cameras at ``positions`` (N, 3) tell apart.

    From the near plane n to infinity a point's images in two cameras, b apart, move against each
    other by f·b/n pixels, evenly in NDC depth.
    """
    apart = torch.cdist(positions[:, :2], positions[:, :2]).max()
    parallax = max(space.focal) * float(apart) / space.near
    return min(max(round(parallax / PIXELS_PER_PLANE) + 1, FEWEST), MOST)
