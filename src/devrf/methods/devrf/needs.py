"""Estimates of the memory that DeVRF's stages need.

Fields are counted at their final resolution, about side³ voxels in any box.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from devrf.engine.needs import LEARNED, StageNeeds, tensor_bytes
from devrf.geometry.ndc import NormalizedDevice
from devrf.methods.devrf.architecture import fitted_to
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.scenes.scene import Scene

# Measured around a free-standing object: the share of a ray's samples that are occupied, and of
# these the share whose colour counts once surfaces have formed.
OCCUPIED, COLOURED = 0.3, 0.25


def canonical_needs(
    settings: Mapping[str, Any], scene: Scene, images: str, processes: int
) -> StageNeeds:
    """Bytes that the canonical stage needs.

    Args:
        settings: the arguments of the stage.
        scene: the scene that is learned.
        images: the config key that changes the images' size.
        processes: the number of processes that share a batch.
    """
    grid, values, ray = _field(settings, scene)
    parts = {
        images: tensor_bytes(scene.static.train),
        grid: LEARNED * values,
        "schedule.canonical.rays": settings["schedule"].rays * ray / processes,
    }
    return StageNeeds(parts, values)


def deformation_needs(
    settings: Mapping[str, Any],
    rest: Mapping[str, Any],
    scene: Scene,
    images: str,
    processes: int,
) -> StageNeeds:
    """Bytes that the deformation stage needs; as above, with the arguments of both stages."""
    schedule: DeformationSchedule = settings["schedule"]
    grid, values, ray = _field(rest, scene)
    # Displacements of a frame: three numbers in both directions. The active one is learned.
    frame, frames = 24 * schedule.levels[-1].side ** 3, len(scene.clock)
    on_device = 1 if settings["motion"].store == "host" else frames
    parts = {
        images: tensor_bytes(scene.dynamic.train),
        grid: values,
        f"schedule.deformation.levels.{len(schedule.levels)}.side": frame * (on_device + LEARNED),
        "schedule.deformation.rays": schedule.rays * COLOURED * ray / processes,
    }
    return StageNeeds(parts, values + frames * frame)


def _field(canonical: Mapping[str, Any], scene: Scene) -> tuple[str, float, float]:
    """The key of the canonical grids' size, and the bytes of their values and of a ray."""
    schedule, sizes = fitted_to(scene, canonical["schedule"], canonical["architecture"])
    # With the graph of its gradients: measured, for each sample whose colour counts.
    sample = 600 + 24 * sizes.width + 96 * sizes.channels
    along = 2 / 3 * schedule.side * OCCUPIED if sizes.planes is None else sizes.planes
    by_pixels = schedule.voxels_per_pixel is not None and isinstance(scene.space, NormalizedDevice)
    key = f"schedule.canonical.{'voxels_per_pixel' if by_pixels else 'side'}"
    values = 4 * (1 + sizes.channels) * schedule.side**3
    return key, values, along / canonical["sampling"].step * sample
