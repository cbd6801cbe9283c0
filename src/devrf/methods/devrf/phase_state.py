"""What DeVRF's stages work with that their schedules do not tell, as plain data, and back.

A progress file holds it beside the tensors (:mod:`devrf.engine.resume`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from devrf.checkpoints.bits import pack_bits, unpack_bits
from devrf.data.pool import PixelPool
from devrf.engine.phase import Phase
from devrf.methods.devrf.active_frame import ActiveFrame
from devrf.methods.devrf.canonical_schedule import CanonicalPhase
from devrf.methods.devrf.deformation_schedule import DeformationPhase
from devrf.methods.devrf.pixel_selection import images_of
from devrf.rendering.occupancy import Occupancy

if TYPE_CHECKING:
    from devrf.methods.devrf.canonical_stage import CanonicalStage
    from devrf.methods.devrf.deformation_stage import DeformationStage


def of_canonical(stage: CanonicalStage) -> dict[str, Any]:
    """The pixels that batches are drawn from."""
    assert stage.pool is not None
    views = stage.scene.static.train
    images = torch.arange(len(views), device=stage.device)
    return {"pixels": pack_bits(stage.pool.mask(images, views.height * views.width))}


def restore_canonical(stage: CanonicalStage, phase: Phase, kept: dict[str, Any]) -> None:
    """Go on with ``phase``, the field being loaded."""
    assert isinstance(phase, CanonicalPhase)
    views = stage.scene.static.train
    stage.scene_model.settings = stage.render_settings(phase)
    shape = (len(views), views.height * views.width)
    images = torch.arange(len(views), device=stage.device)
    stage.pool = PixelPool.of_mask(images, unpack_bits(kept["pixels"], shape, stage.device))
    stage.setup_optimizer(views.cameras)


def of_deformation(stage: DeformationStage) -> dict[str, Any]:
    """What the active frames have at hand, and how their losses fell."""
    return {
        "frames": [_of_frame(stage, frame) for frame in stage.active],
        "losses": [list(seen) for seen in stage.convergence.losses],
    }


def _of_frame(stage: DeformationStage, frame: ActiveFrame) -> dict[str, Any]:
    """Where the frame's matter was last seen, and the pixels to learn from.

    And the displacements themselves, where the field would not keep them exactly.
    """
    views, mask = stage.views, frame.occupancy.mask
    images, area = images_of(views, frame.number), views.height * views.width
    exact = frame.slices if stage.motion.store_half else ()
    return {
        "occupancy": pack_bits(mask),
        "shape": list(mask.shape),
        "pixels": [pack_bits(pool.mask(images, area)) for pool in frame.pools],
        "displacements": [tensor.detach().cpu() for tensor in exact],
    }


def restore_deformation(stage: DeformationStage, phase: Phase, kept: dict[str, Any]) -> None:
    """Go on with the frames of ``phase``, the field being loaded."""
    assert isinstance(phase, DeformationPhase)
    stage.activate(phase)
    stage.convergence.losses = [list(seen) for seen in kept["losses"]]
    for frame, one in zip(stage.active, kept["frames"], strict=True):
        _restore_frame(stage, frame, one)


@torch.no_grad()
def _restore_frame(stage: DeformationStage, frame: ActiveFrame, kept: dict[str, Any]) -> None:
    views = stage.views
    images, area = images_of(views, frame.number), views.height * views.width
    for tensor, exact in zip(frame.slices, kept["displacements"], strict=False):
        tensor.copy_(exact)
    mask = unpack_bits(kept["occupancy"], kept["shape"], stage.device)
    frame.occupancy.refill(Occupancy(mask, stage.scene_model.canonical.box))
    frame.pools = [
        PixelPool.of_mask(images, unpack_bits(bits, (len(images), area), stage.device))
        for bits in kept["pixels"]
    ]
