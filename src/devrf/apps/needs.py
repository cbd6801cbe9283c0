"""What it takes to learn a scene: an estimate of what is large.

Counted are the images, the fields with their gradients and Adam's state, and a batch. The rest is
small beside them; where memory runs out all the same, batches are halved
(:mod:`devrf.engine.stage`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

from torch import Tensor

from devrf.geometry.ndc import NormalizedDevice
from devrf.methods.base import RayTrainable
from devrf.methods.devrf.architecture import fitted_to
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.scenes.scene import Scene

# Python and its libraries on the host; measured, as is what the C library keeps of freed memory.
PROGRAM, FRAGMENTATION = 600_000_000, 1.3
# Values, gradients, Adam's two means, and the copy that a rollback returns to.
LEARNED = 5
# Measured around a free-standing object: the share of a ray's samples that are occupied, and of
# these the share whose colour counts once surfaces have formed.
OCCUPIED, COLOURED = 0.3, 0.25


@dataclass(frozen=True)
class StageNeeds:
    """What a stage needs, in bytes.

    Attributes:
        parts: on the device that trains, by the config key that changes them most: the batch by
            that of its rays.
        learned: the values of the fields.
    """

    parts: Mapping[str, float]
    learned: float

    def peak(self, batch_share: float = 1.0) -> float:
        """Bytes on the device, with ``batch_share`` of each batch."""
        batch = sum(size for key, size in self.parts.items() if key.endswith(".rays"))
        return sum(self.parts.values()) - batch * (1 - batch_share)


def smaller(scene: Scene, by: float) -> Scene:
    """What a scene of images smaller by ``by`` needs: corners of the images stand for them."""

    def corner(of_views: Any) -> Any:
        if not isinstance(of_views, Tensor) or of_views.ndim < 3:
            return of_views
        return of_views[:, : int(of_views.shape[1] / by), : int(of_views.shape[2] / by)]

    captures = [
        capture.mapped(lambda views: views.mapped(corner))
        for capture in (scene.static, scene.dynamic)
    ]
    space = scene.space
    if isinstance(space, NormalizedDevice):
        size = {"width": round(space.width / by), "height": round(space.height / by)}
        space = replace(space, **size, focal=(space.focal[0] / by, space.focal[1] / by))
    return replace(scene, static=captures[0], dynamic=captures[1], space=space)


def host_bytes(
    scene: Scene, stages: Iterable[StageNeeds], *, on_host: bool, batch_share: float = 1.0
) -> float:
    """Bytes that stages need of the host.

    It trains with ``batch_share`` of each batch (``on_host``), or holds what a GPU learns.
    """
    held = (FRAGMENTATION * s.peak(batch_share) if on_host else 2 * s.learned for s in stages)
    return PROGRAM + tensor_bytes(scene.captures.values()) + max(held)


def needs_table(scene: Scene, stages: Mapping[str, StageNeeds]) -> list[tuple[str, float]]:
    """What ``stages`` need, for people: names and bytes."""
    return [
        *((f"GPU, {name} stage", stage.peak()) for name, stage in stages.items()),
        ("host, beside a GPU", host_bytes(scene, stages.values(), on_host=False)),
        ("host, without a GPU", host_bytes(scene, stages.values(), on_host=True)),
        ("checkpoint", max(stage.learned for stage in stages.values())),
    ]


def tensor_bytes(value: object) -> int:
    """Bytes of all tensors in a dataclass (nested too) or an iterable."""
    if isinstance(value, Tensor):
        return value.nbytes
    if is_dataclass(value):
        # Without the names of images, which may be many.
        parts = (field.name for field in fields(value) if field.name != "names")
        return tensor_bytes(getattr(value, part) for part in parts)
    if isinstance(value, Iterable) and not isinstance(value, str):
        return sum(map(tensor_bytes, value))
    return 0


def needs_of_networks(scene: Scene, model: RayTrainable, images: str, rays: float) -> StageNeeds:
    """What a stage needs that trains the whole of a model.

    Args:
        scene: what it learns.
        model: its parameters, on any device.
        images: the config key that changes the images' size.
        rays: of a batch, in each process.
    """
    learned = tensor_bytes(model.parameters())
    parts = {
        images: float(tensor_bytes(scene.captures.values())),
        "ray_stage.model.settings.width": LEARNED * learned,
        # Three values are kept for each output of each layer, for 128 samples of a ray.
        "ray_stage.schedule.rays": rays * 128 * 12 * model.sample_outputs,
    }
    return StageNeeds(parts, learned)


def needs_of_devrf(
    scene: Scene,
    canonical: CanonicalStage,
    moving: DeformationSchedule,
    images: str,
    last_level: str,
    *,
    offloaded: bool,
    processes: int = 1,
) -> dict[str, StageNeeds]:
    """What DeVRF's stages need: fields at their final resolution, about side³ voxels in any box.

    Args:
        scene: what they learn.
        canonical: the canonical stage.
        moving: the schedule of the deformation stage.
        images: the config key that changes the images' size.
        last_level: the name of the schedule's last level in the config.
        offloaded: frames that are not learned are on the host.
        processes: share a batch.
    """
    schedule, sizes = fitted_to(scene, canonical.schedule, canonical.architecture)
    values = 4 * (1 + sizes.channels) * schedule.side**3
    # With the graph of its gradients: measured, for each sample whose colour counts.
    sample = 600 + 24 * sizes.width + 96 * sizes.channels
    along = 2 / 3 * schedule.side * OCCUPIED if sizes.planes is None else sizes.planes
    ray = along / canonical.sampling.step * sample / processes
    by_pixels = schedule.voxels_per_pixel is not None and isinstance(scene.space, NormalizedDevice)
    grid = f"schedule.canonical.{'voxels_per_pixel' if by_pixels else 'side'}"
    at_rest = {
        images: tensor_bytes(scene.static.train),
        grid: LEARNED * values,
        "schedule.canonical.rays": schedule.rays * ray,
    }
    # Displacements of a frame: three numbers in both directions. The active one is learned.
    frame, frames = 24 * moving.levels[-1].side ** 3, len(scene.clock)
    held = 1 if offloaded else frames
    in_motion = {
        images: tensor_bytes(scene.dynamic.train),
        grid: values,
        f"schedule.deformation.levels.{last_level}.side": frame * (held + LEARNED),
        "schedule.deformation.rays": moving.rays * COLOURED * ray,
    }
    return {
        "canonical": StageNeeds(at_rest, values),
        "deformation": StageNeeds(in_motion, values + frames * frame),
    }
