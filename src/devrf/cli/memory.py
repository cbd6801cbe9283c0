"""How much memory and disk a run needs, estimated before it begins.

Everything is a sum over the tensors that will exist, except what a batch takes: see
:func:`batch_bytes`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace

import torch
from torch import Tensor, nn

from devrf.engine.frame_store import active_bytes, resident_bytes
from devrf.methods.devrf.architecture import Architecture, fitted_to
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.settings import MotionSettings
from devrf.scenes.scene import Scene, Views

# Bytes by the config keys that change them, the most effective key first.
Parts = Mapping[tuple[str, ...], int]

IMAGES = ("data.downscale", "data.width", "data.frames")
GRIDS = ("schedule.canonical.side",)
FRAMES = ("schedule.deformation.levels", "data.frames")
PARALLEL = ("schedule.deformation.levels",)

# Python and its libraries on the host, without what the driver of a GPU adds.
PROGRAM = 600_000_000
# Measured on scenes of 48 to 160 pixels: the C library keeps memory that was freed.
FRAGMENTATION = 1.3
# A pixel that batches are drawn from: two int32.
POOLED = 8
# Measured in scenes with a free-standing object: the share of a ray's samples that may be
# occupied, and of those the share whose colour counts once surfaces have formed.
OCCUPIED, DECODED = 0.3, 0.1


@dataclass(frozen=True)
class StageNeeds:
    """What a stage needs at its final resolution, in bytes.

    Attributes:
        views: the training views, on the training device.
        held: what that device holds all the time besides.
        batch: the batches that a GPU works on at the same time.
        rays: the config key of the batch size.
        temporary: the most that other work takes between batches.
        learned: the learned tensors in memory.
        checkpoint: the file of the finished stage.
        progress: a progress file.
        batches: how many batches ``batch`` counts; a CPU takes one after the other.
    """

    views: int
    held: Parts
    batch: int
    rays: str
    temporary: int
    learned: int
    checkpoint: int
    progress: int
    batches: int = 1

    def peak(self, pieces: int = 1) -> int:
        """Peak bytes on the device, with each batch taken in ``pieces``."""
        return self.views + sum(self.held.values()) + max(self.batch // pieces, self.temporary)

    @property
    def on_host(self) -> int:
        """Peak bytes beside the scene's where the host trains; it uses the views in place."""
        return round(FRAGMENTATION * (self.peak(self.batches) - self.views))


@dataclass(frozen=True)
class Budget:
    """What a run needs: ``scene``, bytes of all its views, and its stages in their order."""

    scene: int
    stages: Mapping[str, StageNeeds]

    def host(self, *, alone: bool, processes: int = 1) -> int:
        """Bytes on the host.

        Args:
            alone: whether the host trains. Otherwise it holds what a GPU has learned, to write it,
                and the checkpoint, to score it.
            processes: how many train together on this machine, each with its copy of the scene.
        """
        own = [one.learned + one.checkpoint for one in self.stages.values()]
        if alone:
            own += [one.on_host for one in self.stages.values()]
        return processes * (PROGRAM + self.scene + max(own))

    def disk(self, *, kept: int, films: int = 0) -> int:
        """Bytes of files, with ``kept`` progress files beside the one that is being written."""
        worst = finished = 0
        for one in self.stages.values():
            written = kept * one.progress + max(one.progress, one.checkpoint)
            worst, finished = max(worst, finished + written), finished + one.checkpoint
        return max(worst, finished + films)

    def rows(self) -> list[tuple[str, int]]:
        """A table of names and bytes."""
        return [
            *((f"GPU, {name} stage", one.peak()) for name, one in self.stages.items()),
            ("host, beside a GPU", self.host(alone=False)),
            ("host, without a GPU", self.host(alone=True)),
            ("checkpoint", max(one.checkpoint for one in self.stages.values())),
        ]


def tensor_bytes(value: object) -> int:
    """Bytes of all tensors in a module's state, a dataclass (nested too) or an iterable."""
    if isinstance(value, Tensor):
        return value.nbytes
    if isinstance(value, nn.Module):
        return tensor_bytes(value.state_dict().values())
    if is_dataclass(value):
        return tensor_bytes(getattr(value, field.name) for field in fields(value))
    if isinstance(value, Iterable) and not isinstance(value, str):
        return sum(tensor_bytes(one) for one in value)
    return 0


def module_needs(
    module: nn.Module, views: Views, *, keys: tuple[str, ...], batch: int, rays: str
) -> StageNeeds:
    """What a stage needs that trains all of a module with Adam.

    Args:
        module: may be on torch's meta device.
        views: the training views.
        keys: the config keys of the module's size.
        batch: as in :class:`StageNeeds`.
        rays: as in :class:`StageNeeds`.
    """
    stored, parameters = tensor_bytes(module), tensor_bytes(module.parameters())
    pool = len(views) * views.height * views.width * POOLED
    return StageNeeds(
        views=tensor_bytes(views),
        # Gradients, two moments, and the copy that a rollback returns to.
        held={keys: stored + 4 * parameters, IMAGES: pool},
        batch=batch,
        rays=rays,
        temporary=2 * parameters,  # an optimiser step
        learned=stored,
        checkpoint=stored,
        progress=stored + 2 * parameters,
    )


def batch_bytes(
    samples: float, decoded: float, channels: int, width: int, *, warped: bool = False
) -> int:
    """About what a batch takes, with the graph of its gradients.

    Counted from the tensors that are alive at once: 230 bytes for each of ``samples`` (position,
    ray, rows and weights of eight corners), 200 more where it is ``warped``. Each of ``decoded``,
    whose colour is computed, takes 6 float32 for each hidden unit (``width``), 24 for each feature
    channel, and 400 bytes besides.
    """
    color = 4 * (6 * width + 24 * channels) + 400
    return round((430 if warped else 230) * samples + color * decoded)


def samples_per_ray(field: CanonicalField, voxels: int, step: float) -> float:
    """Samples of a ray through the whole box, ``step`` voxels apart.

    In a box of cubic voxels, on the mean chord of a convex body: 4 · volume / surface.
    """
    if field.planes is not None:
        return (field.planes - 1) / step + 1
    x, y, z = field.box.size
    chord = 2 * field.box.volume / (x * y + y * z + z * x)
    return chord / (step * field.box.voxel_size(voxels))


def estimate(
    scene: Scene,
    canonical: CanonicalSchedule,
    deformation: DeformationSchedule,
    architecture: Architecture,
    step: float = 0.5,
    motion: MotionSettings | None = None,
) -> Budget:
    """What DeVRF needs to learn ``scene``, with samples ``step`` voxels apart.

    The fields' box is taken to be the scene's motion box, or its box where that is unknown: grids
    have about side³ voxels in any box. A store of displacements that is ``auto`` counts as on the
    device.
    """
    canonical, architecture = fitted_to(scene, canonical, architecture)
    voxels, sizes = round(canonical.side**3), (architecture.channels, architecture.width)
    with torch.device("meta"):
        box = (scene.space.is_linear and scene.bounds.motion) or scene.bounds.box
        field = architecture.radiance_field(box, voxels, voxels)
    occupied = OCCUPIED if field.planes is None else 1.0

    # The search samples the whole box; its three channels are the colour. The first fine phase
    # begins as fog: the colour of every sample counts.
    first = next(phase for phase in canonical.phases if phase.kind == "fine")
    fog = canonical.rays * occupied * samples_per_ray(field, first.voxels, step)
    batch = batch_bytes(fog, fog, *sizes)
    if canonical.search_iterations:
        seen = canonical.rays * samples_per_ray(field, canonical.search_side**3, step)
        batch = max(batch, batch_bytes(seen, seen, 3, 0))
    rest = _canonical_needs(scene, field, batch)

    met = deformation.rays * occupied * samples_per_ray(field, voxels, step)
    batch = batch_bytes(met, DECODED * met, *sizes, warped=True)
    motion = motion or MotionSettings()
    moving = [
        _level_needs(scene, field, rest, deformation, level, motion, batch)
        for level in range(len(deformation.levels))
    ]
    everything = tensor_bytes(scene.captures.values())
    return Budget(everything, {"canonical": rest, "deformation": max(moving, key=StageNeeds.peak)})


def _canonical_needs(scene: Scene, field: CanonicalField, batch: int) -> StageNeeds:
    points, grids = field.density.values.numel(), tensor_bytes((field.density, field.color))
    rays = "schedule.canonical.rays"
    needs = module_needs(field, scene.static.train, keys=GRIDS, batch=batch, rays=rays)
    return replace(
        needs,
        held={**needs.held, GRIDS: needs.held[GRIDS] + 2 * points},  # with occupancy
        temporary=max(needs.temporary, 80 * points),  # updating the occupancy
        learned=needs.learned + points,
        checkpoint=needs.checkpoint - grids // 2 + points,  # in half precision
        progress=needs.progress + 5 * points,  # with the number of views of each voxel
    )


def _level_needs(
    scene: Scene,
    field: CanonicalField,
    rest: StageNeeds,
    schedule: DeformationSchedule,
    level: int,
    motion: MotionSettings,
    batch: int,
) -> StageNeeds:
    """What the deformation stage needs at a level, on top of the canonical field."""
    views, frames, points = scene.dynamic.train, len(scene.clock), field.density.values.numel()
    shape, final = (field.box.grid_shape(schedule.levels[k].side ** 3) for k in (level, -1))
    parallel, slices = schedule.max_parallel_frames(level, frames), resident_bytes(1, shape, False)
    pool = views.height * views.width * -(-len(views) // frames) * POOLED
    if motion.store == "host":  # with the next frames, which are being copied
        resident, active = 0, active_bytes(shape) + slices
    else:
        half = motion.store_half is True  # auto is not known to be a GPU's
        resident, active = resident_bytes(frames, shape, half), active_bytes(shape)
    learned = resident_bytes(frames, final, False)
    moments = 2 * resident_bytes(schedule.max_parallel_frames(-1, frames), final, False)
    return StageNeeds(
        views=tensor_bytes(views),
        held={
            IMAGES: parallel * pool,
            GRIDS: rest.learned + (2 + parallel) * points,  # with occupancy
            FRAMES: resident + (active if parallel == 1 else 0),
            PARALLEL: parallel * active if parallel > 1 else 0,
        },
        batch=parallel * batch,
        rays="schedule.deformation.rays",
        # An optimiser step with a smoothed copy of each frame, or updating the occupancy.
        temporary=max((1 + parallel) * slices, 200 * points),
        learned=rest.learned + learned,
        checkpoint=rest.checkpoint + learned // 2,
        progress=rest.learned + learned + moments,
        batches=parallel,
    )
