"""At which depths of a forward-facing scene there is something (docs/method.md#crop)."""

from __future__ import annotations

import logging

import torch
from torch import Tensor, nn

from devrf.data.batch import PixelPool
from devrf.geometry.box import Box
from devrf.geometry.ndc import NormalizedDevice
from devrf.kernels.march import march
from devrf.methods.batch import gather_batch
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.volume_rendering import march_inputs
from devrf.scenes.bounds import box_between
from devrf.scenes.scene import Scene, Views

log = logging.getLogger(__name__)

# As many rays are looked along.
RAYS = 8192
# This share of all that is seen may lie in front of the box, and as much behind it: remains of fog.
FOG = 0.1
# So may the surfaces of this share of the rays: specks.
SPECKS = 1e-3
# Room in front, into which things may move, and behind, in shares of the depth that is seen.
IN_FRONT = 0.25
BEHIND = 0.05


def crop_to_visible(model: DeVRFModel, scene: Scene, views: Views, pool: PixelPool) -> None:
    """Crop the canonical field in NDC to the depths that show in the static views.

    Sideways it keeps the training cameras' view at those depths.

    Args:
        model: the scene at rest as learned so far; its field is changed.
        scene: gives space and cameras.
        views: the training views, on the model's device.
        pool: the pixels of ``views`` that are drawn from.
    """
    space = scene.space
    field = model.canonical
    if not isinstance(space, NormalizedDevice):
        return
    depths, weights, rays = seen_along_rays(model, views, pool)
    if not len(depths):  # a field that has become empty is refused by its stage
        return
    front, back = with_room(visible_depths(depths, weights, rays), field.box)
    learned_from = [scene.static.train, scene.dynamic.train]
    box = box_between(learned_from, space, front, back).clipped(field.box)
    before = field.density.values.numel()
    crop(field, box)
    share = field.density.values.numel() / before
    log.info("fields live in %s now, in %.0f%% of the voxels", box, 100 * share)


@torch.no_grad()
def crop(field: CanonicalField, box: Box) -> None:
    """Crop a field with planes to ``box``, a part of its own, at the same resolution.

    New parameters result.
    """
    assert field.planes is not None, "only fields with planes are cropped"
    before = field.box
    width, height, depth = box.size
    whole_width, whole_height, whole_depth = before.size
    planes = max(2, round((field.planes - 1) * depth / whole_depth) + 1)
    share = width * height * planes / (whole_width * whole_height * field.planes)
    field.box = box
    field.planes = planes
    field.voxels = round(field.voxels * share)
    field.base_voxels = round(field.base_voxels * share)
    points = box.grid_points(field.grid_shape(field.voxels), field.density.values)
    for grid in (field.density, field.color):
        values = grid(points.view(-1, 3), before)
        grid.values = nn.Parameter(values.view(*points.shape[:3], -1))


@torch.no_grad()
def seen_along_rays(
    model: DeVRFModel, views: Views, pool: PixelPool
) -> tuple[Tensor, Tensor, Tensor]:
    """Samples on rays through pixels of ``pool``: depths z', weights, and rays, each (S,)."""
    # Evenly spread, not random: several processes have to find the same depths.
    subset = torch.linspace(0, len(pool) - 1, min(RAYS, len(pool)), dtype=torch.float64)
    image, flat = pool.pixels[:, subset.long().to(pool.pixels.device)].long()
    black = torch.zeros(3, device=model.device)
    rays = gather_batch(views, image, flat, black, model.space).rays
    samples = march(rays, march_inputs(model.canonical, model.occupancy, model.settings))
    return samples.points[:, 2], samples.weight, samples.ray


def visible_depths(depths: Tensor, weights: Tensor, ray: Tensor) -> tuple[float, float]:
    """The depths that hold all but fog and specks.

    The surface that a ray meets is at half of its weight. While nothing is known, all is fog, and
    no depth is given up.

    Args:
        depths: (S,) of samples, ascending on each ray.
        weights: (S,) of the samples in their rays.
        ray: (S,) int64 their rays, ascending.
    """
    ascending, order = depths.sort()
    of_all = _ends(ascending, weights[order].double(), FOG)
    weights = weights.double()
    total = weights.cumsum(0)
    _, count = torch.unique_consecutive(ray, return_counts=True)
    last = count.cumsum(0) - 1
    before = torch.cat([total.new_zeros(1), total[last[:-1]]])
    half = torch.searchsorted(total, (before + total[last]) / 2).clamp(max=len(total) - 1)
    surfaces = depths[half].sort().values
    of_surfaces = _ends(surfaces, torch.ones_like(surfaces, dtype=torch.double), SPECKS)
    return min(of_all[0], of_surfaces[0]), max(of_all[1], of_surfaces[1])


def _ends(ascending: Tensor, weights: Tensor, outside: float) -> tuple[float, float]:
    """Depths before and behind which a share ``outside`` of the weights (S,) is."""
    total = weights.cumsum(0)
    ends = total.new_tensor([outside, 1 - outside]) * total[-1]
    index = torch.searchsorted(total, ends).clamp(max=len(ascending) - 1)
    first, last = ascending[index].tolist()
    return first, last


def with_room(ends: tuple[float, float], box: Box) -> tuple[float, float]:
    """Depths with room for motion in front and a margin behind, within ``box``."""
    first, last = ends
    depth = max(last - first, 0.05 * box.size[2])
    return max(first - IN_FRONT * depth, box.low[2]), min(last + BEHIND * depth, box.high[2])
