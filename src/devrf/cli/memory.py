"""How much memory a run will need, before it has cost any time.

Images, fields, gradients and moments are counted from their shapes. What a batch takes depends
on what will be learned; that part is estimated, as :func:`batch_bytes` says.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import nn

from devrf.engine.micro_batching import MicroBatching
from devrf.geometry.box import Box
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.color_decoder import ColorDecoder
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.settings import MotionSettings
from devrf.scenes.scene import Scene, Views

# Python and its libraries on the host, without what the driver of a GPU adds.
PROGRAM = 600_000_000
# What the C library keeps of memory that was freed in between makes a stage on the host so much
# larger than its tensors: measured on scenes of 48 to 160 pixels.
KEPT_BACK = 1.3
# What passes, by name; and what a stage shares with the scene where both are on the host.
BATCH = "a batch"
VIEWS = ("images", "optical flow", "depth", "masks")
# Two int32 tell a pixel of a pool.
POOLED = 8
# A displacement: three float32.
DISPLACEMENT = 12

# Counted from the tensors that live at once, in bytes a sample or a grid point.
MARCHED = 230  # positions, ray numbers, corner rows and weights of a density look-up
WARPED = 200  # the same for a look-up of the displacement
SOUGHT = 80  # looking at a grid point for the canonical occupancy
SOUGHT_WARPED = 200  # the same through a warp
# Shares met in scenes with a free-standing object: of a ray's way through the box that may be
# occupied, and of those samples whose colour is computed once surfaces have formed.
OCCUPIED = 0.3
DECODED = 0.1


@dataclass(frozen=True)
class StageMemory:
    """What a stage needs on the device that it trains on, bytes by part.

    Attributes:
        held: there all the time, at the final resolution.
        passing: needed one after another, and given back each time.
        batches: how many batches a GPU works on at the same time; ``passing`` counts them all.
    """

    held: Mapping[str, int]
    passing: Mapping[str, int]
    batches: int = 1

    @property
    def peak(self) -> int:
        """Bytes at the worst moment: all that is held, and the largest of what passes."""
        return sum(self.held.values()) + max(self.passing.values(), default=0)

    @property
    def least(self) -> int:
        """Bytes at the worst moment when batches are taken in as many parts as is tried."""
        return self._with_less(MicroBatching.MOST).peak

    @property
    def on_host(self) -> int:
        """Bytes on the host at the worst moment; the scene's own images are used in place.

        A CPU takes one batch after the other.
        """
        views = sum(self.held.get(name, 0) for name in VIEWS)
        return round(KEPT_BACK * (self._with_less(self.batches).peak - views))

    def _with_less(self, parts: int) -> StageMemory:
        """The same with one part of what batches take."""
        passing = {
            name: size // parts if name == BATCH else size for name, size in self.passing.items()
        }
        return replace(self, passing=passing)


@dataclass(frozen=True)
class StageFiles:
    """What a stage writes, in bytes.

    Attributes:
        finished: its checkpoint.
        progress: one of its progress files at the final resolution.
    """

    finished: int
    progress: int

    def peak(self, kept: int) -> int:
        """The most that is there at once: ``kept`` progress files and a file being written."""
        return kept * self.progress + max(self.progress, self.finished)


@dataclass(frozen=True)
class Budget:
    """What a run needs, bytes by part.

    Attributes:
        scene: what the scene takes on the host, training and held-out views.
        canonical: the canonical stage on its device.
        deformation: the deformation stage on its device.
        fields: what is learned, as it is worked with.
        checkpoint: the same in ``deformation.ckpt``, at most: in half precision. Away from
            matter less is kept.
        files: what each stage writes, by its name.
    """

    scene: Mapping[str, int]
    canonical: StageMemory
    deformation: StageMemory
    fields: Mapping[str, int]
    checkpoint: Mapping[str, int]
    files: Mapping[str, StageFiles]

    @property
    def gpu(self) -> int:
        """Bytes that a GPU needs for both stages, without the driver's own (about 0.5 GB)."""
        return max(self.canonical.peak, self.deformation.peak)

    @property
    def host(self) -> int:
        """Bytes on the host of a run that trains on a GPU.

        Scoring reads the checkpoint and builds its model.
        """
        learned = sum(self.fields.values()) + sum(self.checkpoint.values())
        return PROGRAM + sum(self.scene.values()) + learned

    @property
    def host_alone(self) -> int:
        """Bytes on the host of a run without a GPU: the stages use the scene's images in place."""
        own = max(self.canonical.on_host, self.deformation.on_host)
        return max(self.host, PROGRAM + sum(self.scene.values()) + own)


def estimate(
    scene: Scene,
    canonical: CanonicalSchedule,
    deformation: DeformationSchedule,
    architecture: Architecture,
    step: float = 0.5,
    motion: MotionSettings | None = None,
) -> Budget:
    """What a run on ``scene`` will need.

    The fields' box is taken to be the scene's motion box, or its box where that is unknown.
    Grids have about side³ voxels whatever the box, so a tighter one changes little.

    Args:
        scene: images, times and box.
        canonical: grid sizes and rays of the canonical stage.
        deformation: grid sizes and rays of the deformation stage.
        architecture: sizes of the canonical field.
        step: distance between samples in voxels.
        motion: where the displacements rest, and how; ``auto`` counts as on the device.
    """
    motion = motion or MotionSettings()
    field = final_field(scene, canonical, architecture)
    grids, decoder = _grid_bytes(field), tensor_bytes(field.decoder)
    points, moving = field.density.values.numel(), _all_frames(scene)
    displacements = displacement_bytes(scene, field.box, deformation.sides[-1])
    together = deformation.max_parallel_frames(len(deformation.sides) - 1, len(scene.clock))
    rest = grids + decoder + points
    fields = {
        "density and features": grids,
        "decoder": decoder,
        "occupancy": points,
        moving: displacements,
    }
    checkpoint = {
        **fields,
        "density and features": grids // 2,
        moving: displacements // 2,
    }
    return Budget(
        scene=_sum(
            [
                view_bytes(views)
                for capture in (scene.static, scene.dynamic)
                for views in (capture.train, capture.test)
            ]
        ),
        canonical=canonical_memory(scene, canonical, architecture, step),
        deformation=motion_memory(
            scene,
            field,
            deformation,
            step,
            on_host=motion.store == "host",
            half=motion.store_half,
        ),
        fields=fields,
        checkpoint=checkpoint,
        files={
            # With moments, and the share of the views of each voxel.
            "canonical": StageFiles(
                sum(checkpoint.values()) - checkpoint[moving],
                rest + 2 * (grids + decoder) + 4 * points,
            ),
            "deformation": StageFiles(
                sum(checkpoint.values()),
                rest + displacements + 2 * together * displacements // len(scene.clock),
            ),
        },
    )


def final_field(
    scene: Scene, schedule: CanonicalSchedule, architecture: Architecture
) -> CanonicalField:
    """The radiance field that a schedule leads to, without its memory."""
    voxels = round(schedule.side**3)
    with torch.device("meta"):
        return architecture.radiance_field(scene.bounds.motion or scene.bounds.box, voxels, voxels)


def canonical_memory(
    scene: Scene, schedule: CanonicalSchedule, architecture: Architecture, step: float
) -> StageMemory:
    """What the canonical stage needs; arguments as :func:`estimate`."""
    field, static = final_field(scene, schedule, architecture), scene.static.train
    points, grids = field.density.values.numel(), _grid_bytes(field)
    return StageMemory(
        held={
            **view_bytes(static),
            "pixels to draw from": len(static) * static.height * static.width * POOLED,
            "density and features": grids,
            "their gradients": grids,
            "their Adam moments": 2 * grids,
            "decoder, with gradients and moments": 4 * tensor_bytes(field.decoder),
            "a copy to go back to": grids + tensor_bytes(field.decoder),
            "occupancy": 2 * points,
        },
        passing={
            BATCH: max(
                batch_bytes(schedule, k, architecture, field.box, step)
                for k in range(len(schedule.phases))
            ),
            "an optimiser step": 2 * grids,
            "looking for what is occupied": SOUGHT * points,
        },
    )


def motion_memory(
    scene: Scene,
    field: CanonicalField,
    schedule: DeformationSchedule,
    step: float,
    *,
    on_host: bool,
    half: bool,
) -> StageMemory:
    """What the deformation stage needs on its device, at the level that needs most.

    Args:
        scene: images and times.
        field: the canonical field that it builds on.
        schedule: grid sizes and rays.
        step: distance between samples in voxels.
        on_host: whether the displacements of all frames rest on the host.
        half: whether they rest in half precision.
    """
    levels = [
        _level_memory(scene, field, schedule, step, level, on_host=on_host, half=half)
        for level in range(len(schedule.sides))
    ]
    return max(levels, key=lambda memory: memory.peak)


def _level_memory(
    scene: Scene,
    field: CanonicalField,
    schedule: DeformationSchedule,
    step: float,
    level: int,
    *,
    on_host: bool,
    half: bool,
) -> StageMemory:
    """What one level of the deformation stage needs; arguments as :func:`motion_memory`."""
    dynamic, frames, points = scene.dynamic.train, len(scene.clock), field.density.values.numel()
    displacements = displacement_bytes(scene, field.box, schedule.sides[level])
    slices, growth = displacements // frames, 0
    if level:
        # One direction after the other: the old grids of one stand beside the new of both.
        growth = displacement_bytes(scene, field.box, schedule.sides[level - 1]) // 2
    if half:
        displacements, growth = displacements // 2, growth // 2
    rested = {} if on_host else {_all_frames(scene): displacements}
    channels, width = field.color.values.shape[-1], _width(field)
    together = schedule.max_parallel_frames(level, frames)
    visited = "one frame" if together == 1 else f"{together} frames side by side"
    return StageMemory(
        held={
            **view_bytes(dynamic),
            "pixels to draw from": dynamic.height
            * dynamic.width
            * -(-len(dynamic) // frames)
            * POOLED
            * together,
            "density and features": _grid_bytes(field),
            "decoder": tensor_bytes(field.decoder),
            "occupancy": (3 + together) * points,
            **rested,
            # Both its directions, the forward one of the frame before it; on their way from the
            # host, those of the frame after it.
            visited: (5 if on_host else 3) * slices * together // 2,
            f"gradients of {visited}": slices * together,
            f"Adam moments of {visited}": 2 * slices * together,
            f"a copy of {visited} to go back to": slices * together,
        },
        passing={
            BATCH: together
            * motion_batch_bytes(
                schedule.rays,
                samples_per_ray(field.box, field.base_voxels, field.planes, step),
                channels,
                width,
                planes=field.planes,
            ),
            # What is smoothed has a place beside it, one frame after the other the rest.
            "an optimiser step": (1 + together) * slices,
            "looking for what is occupied": SOUGHT_WARPED * points,
            "growing the grids": 0 if on_host else growth,
        },
        batches=together,
    )


def displacement_bytes(scene: Scene, box: Box, side: int) -> int:
    """Bytes of the displacements of all frames, both ways, in single precision, on side³ voxels."""
    x, y, z = box.grid_shape(side**3)
    return 2 * len(scene.clock) * x * y * z * DISPLACEMENT


def _all_frames(scene: Scene) -> str:
    return f"displacements of {len(scene.clock)} frames, both ways"


def _grid_bytes(field: CanonicalField) -> int:
    return tensor_bytes(field.density) + tensor_bytes(field.color)


def _width(field: CanonicalField) -> int:
    """Units of a hidden layer of the field's decoder; 0 if it has none."""
    return field.decoder.hidden.out_features if isinstance(field.decoder, ColorDecoder) else 0


def tensor_bytes(module: nn.Module) -> int:
    """Bytes of a module's parameters and of the buffers that a checkpoint keeps."""
    kept = (v for v in module.state_dict().values() if isinstance(v, torch.Tensor))
    return sum(v.numel() * v.element_size() for v in kept)


def view_bytes(views: Views) -> dict[str, int]:
    """Bytes of N views by part: ``images``, and what else they have of :data:`VIEWS`."""
    parts = {"images": views.pixels.numel()}
    if views.flow is not None:
        parts["optical flow"] = 4 * views.flow.vectors.numel() + views.flow.valid.numel()
    if views.depth is not None:
        parts["depth"] = 4 * views.depth.numel()
    if views.valid_mask is not None:
        parts["masks"] = views.valid_mask.numel()
    return parts


def samples_per_ray(box: Box, voxels: int, planes: int | None, step: float) -> float:
    """Samples of a ray through the whole box.

    In a box of cubic voxels, on the mean chord of a convex body: 4 · volume / surface.
    """
    if planes is not None:
        return (planes - 1) / step + 1
    x, y, z = box.size
    chord = 2 * box.volume / (x * y + y * z + z * x)
    return chord / (step * box.voxel_size(voxels))


def batch_bytes(
    schedule: CanonicalSchedule, phase: int, architecture: Architecture, box: Box, step: float
) -> int:
    """About what a batch of the canonical stage takes in one phase of its schedule.

    The search looks everywhere, and so do planes. The radiance field looks where the search
    found something; in its first phase that is fog, and the colour of every sample counts.
    """
    now, planes = schedule.phases[phase], architecture.planes
    searching = now.kind == "search"
    foggy = searching or phase == 0 or schedule.phases[phase - 1].kind == "search"
    samples = schedule.rays * samples_per_ray(box, now.voxels, planes, step)
    if not searching and planes is None:
        samples *= OCCUPIED
    decoded = samples if foggy else DECODED * samples
    sizes = (3, 0) if searching else (architecture.channels, architecture.width)
    return round(MARCHED * samples + _color_bytes(*sizes) * decoded)


def motion_batch_bytes(
    rays: int, samples: float, channels: int, width: int, *, planes: int | None
) -> int:
    """About what a batch of the deformation stage takes, of ``rays`` with ``samples`` each."""
    met = rays * samples * (OCCUPIED if planes is None else 1.0)
    return round((MARCHED + WARPED) * met + _color_bytes(channels, width) * DECODED * met)


def _color_bytes(channels: int, width: int) -> int:
    """Bytes of a sample whose colour is computed, with all that its gradient needs."""
    return 4 * (6 * width + 24 * channels) + 400


def _sum(parts: list[dict[str, int]]) -> dict[str, int]:
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: sum(part.get(name, 0) for part in parts) for name in names}
