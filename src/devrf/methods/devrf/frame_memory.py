"""Bytes of the motion grids, and whether all frames fit on a GPU (docs/method.md#warp)."""

from __future__ import annotations

import logging

import torch
from lightning import Trainer

from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import MotionSettings

log = logging.getLogger(__name__)

Shape = tuple[int, int, int]

# A displacement: three float32.
DISPLACEMENT = 12
# Grids of an active frame: both directions and the forward one of the frame before (3),
# gradients (2), Adam moments (4), and the copy that a rollback returns to (2).
ACTIVE_GRIDS = 11
# The share of a GPU's free memory that frames may take. The rest is for images, the canonical
# field and batches.
FRAMES_SHARE = 0.75


def resident_bytes(frames: int, shape: Shape, half: bool) -> int:
    """Bytes of T ``frames`` in both directions, on grids of ``shape``, or ``half`` of them."""
    x, y, z = shape
    return 2 * frames * x * y * z * DISPLACEMENT // (2 if half else 1)


def active_bytes(shape: Shape) -> int:
    """Bytes of an active frame on a grid of ``shape``."""
    x, y, z = shape
    return ACTIVE_GRIDS * x * y * z * DISPLACEMENT


def fits_on_device(free: int, frames: int, shape: Shape, *, half: bool, parallel: int) -> bool:
    """Whether T ``frames``, ``parallel`` of them active, fit into ``free`` bytes of a GPU."""
    needed = resident_bytes(frames, shape, half) + parallel * active_bytes(shape)
    return needed <= FRAMES_SHARE * free


def rest_on_host(
    trainer: Trainer, model: DeVRFModel, schedule: DeformationSchedule, motion: MotionSettings
) -> bool:
    """Whether ``model``'s displacements are kept on the host; several processes never do."""
    device = trainer.strategy.root_device
    if trainer.world_size > 1 or motion.store == "device":
        return False
    if motion.store == "host":
        return True
    if device.type != "cuda":
        return False
    assert model.deformation is not None
    free, _ = torch.cuda.mem_get_info(device)
    motion_box, frames = model.deformation.box, len(model.deformation.clock)
    shape = motion_box.grid_shape(schedule.levels[-1].side ** 3)
    parallel = schedule.max_parallel_frames(-1, frames)
    half = motion.rests_half(device)
    fits = fits_on_device(free, frames, shape, half=half, parallel=parallel)
    if not fits:
        log.info("motion: %.1f GB are free on the GPU; the frames rest on the host", free / 1e9)
    return not fits
