"""Where the displacements of all frames rest: on the device if they fit there beside all else."""

from __future__ import annotations

import logging

import torch
from lightning import Trainer

from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import MotionSettings

log = logging.getLogger(__name__)

# Of the memory that is free, the share that the frames may take: the rest is for batches,
# gradients and moments.
SHARE = 0.5


def rest_on_host(
    trainer: Trainer, model: DeVRFModel, schedule: DeformationSchedule, motion: MotionSettings
) -> bool:
    """Whether the displacements of all frames are kept on the host.

    Args:
        trainer: trains the stage; of several processes each keeps them on its device.
        model: the field that is learned.
        schedule: the finest grid.
        motion: what was asked for.
    """
    device = trainer.strategy.root_device
    if trainer.world_size > 1 or motion.store == "device":
        return False
    if motion.store == "host":
        return True
    if device.type != "cuda" or model.deformation is None:
        return False
    free, _ = torch.cuda.mem_get_info(device)
    shape = model.box.grid_shape(schedule.sides[-1] ** 3)
    frames = len(model.deformation.clock)
    too_much = resident_bytes(frames, shape, half=motion.store_half) > SHARE * free
    if too_much:
        log.info("motion: %.1f GB are free on the GPU; the frames rest on the host", free / 1e9)
    return too_much


def resident_bytes(frames: int, shape: tuple[int, int, int], *, half: bool) -> int:
    """Bytes of the displacements of all frames, in both directions."""
    x, y, z = shape
    return 2 * frames * x * y * z * 3 * (2 if half else 4)
