"""The world of ``poses.npy``: LLFF's normalised one, or any that its static cameras tell."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from devrf.geometry.poses import average_pose, relative_to
from devrf.scenes.formats.llff_poses import PosedSet
from devrf.scenes.splits import distinct_poses

log = logging.getLogger(__name__)

# Static cameras of another reconstruction fit up to this: entries of rotations, and positions as
# shares of the distance of the outermost camera from their middle.
NEAR_FIT = 0.02


def in_static_world(moving: PosedSet, views: int, static: PosedSet, world: PosedSet) -> Tensor:
    """Poses (``views``, 3, 4) of the fixed cameras in the ``world``: ``static``, normalised.

    The fixed cameras are the last rows of ``moving``; rows before them are static cameras again,
    and tell the world that they are in: ``world``, that of ``static``, or another, moved and
    scaled, if they are the first rows of ``static`` in its order. Without them, or where they fit
    none, as a warning says, it is ``world``.
    """
    shared, fixed = moving.poses[:-views], moving.poses[-views:]
    if len(shared) == 0 or _are_among(shared, world.poses):
        return fixed
    # As the static cameras were normalised.
    middle, scale = average_pose(static.poses), float(world.bounds.max() / static.bounds.max())
    if _are_among(relative_to(middle, shared, scale), world.poses):
        log.info("%s: in the world of %s", moving.file, static.file)
        return relative_to(middle, fixed, scale)
    count = min(len(shared), len(world))
    first = world.poses[:count]
    other = similarity(shared[:count], first)
    if other and len(shared) == count:
        off = (relative_to(other[0], shared, other[1]) - first).abs()
        reach = (world.poses[:, :, 3] - world.poses[:, :, 3].mean(dim=0)).norm(dim=1).max()
        if float(off[:, :, :3].max()) <= NEAR_FIT and float(off[:, :, 3].max() / reach) <= NEAR_FIT:
            log.info(
                "%s: in a world of its own, brought to that of its static cameras", moving.file
            )
            return relative_to(other[0], fixed, other[1])
    log.warning(
        "%s: its first %d cameras are not those of %s, neither in one world with them nor moved "
        "and scaled; the others are taken to be in LLFF's normalised world. Else write the static "
        "cameras first, in that file's order",
        moving.file,
        len(shared),
        static.file.name,
    )
    return fixed


def similarity(poses: Tensor, targets: Tensor) -> tuple[Tensor, float] | None:
    """The frame (3, 4) and scale by which :func:`relative_to` brings ``poses`` to ``targets``.

    Both are (N, 3, 4), rigid. The rotation is that nearest to the cameras' own, the scale and the
    origin are least squares of positions. None if these tell no scale above 0.
    """
    left, _, right = torch.linalg.svd((poses[:, :, :3] @ targets[:, :, :3].mT).sum(dim=0))
    turned = left @ right
    middle, target = poses[:, :, 3].mean(dim=0), targets[:, :, 3].mean(dim=0)
    spread = (poses[:, :, 3] - middle) @ turned
    scale = float((spread * (targets[:, :, 3] - target)).sum() / spread.square().sum())
    # NaN compares false.
    if not 0 < scale < float("inf"):
        return None
    return torch.cat([turned, (middle - turned @ target / scale)[:, None]], dim=1), scale


def _are_among(poses: Tensor, others: Tensor) -> bool:
    """Whether each of ``poses`` (K, 3, 4) is one of the ``others`` (N, 3, 4)."""
    number = distinct_poses(torch.cat([others, poses]))
    return bool(torch.isin(number[len(others) :], number[: len(others)]).all())
