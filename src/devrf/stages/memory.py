"""How much memory a run will need, before it has cost any time.

Images, fields, gradients and moments are counted from their shapes. What a batch takes depends
on what will be learned; that part is estimated, as :func:`batch_bytes` says.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import nn

from devrf.fields.architecture import Architecture
from devrf.fields.deformation import DeformationField
from devrf.geometry.box import Box
from devrf.scenes.scene import Scene, Views
from devrf.stages.parts import Parts
from devrf.stages.schedules import CanonicalSchedule, DeformationSchedule

# Python and its libraries on the host, without what the driver of a GPU adds.
PROGRAM = 600_000_000
# What the C library keeps of memory that was freed in between makes a stage on the host so much
# larger than its tensors: measured on scenes of 48 to 160 pixels.
KEPT_BACK = 1.3
# What passes, by name; and what a stage shares with the scene where both are on the host.
BATCH = "a batch"
VIEWS = ("images", "optical flow", "depth")
# Two int32 tell a pixel of a pool.
POOLED = 8
# A displacement: three float32.
DISPLACEMENT = 12

# Counted from the tensors that live at once, in bytes a sample or a grid point.
MARCHED = 230       # positions, ray numbers, corner rows and weights of a density look-up
WARPED = 200        # the same for a look-up of the displacement
SOUGHT = 80         # looking at a grid point for the canonical occupancy
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
    """

    held: Mapping[str, int]
    passing: Mapping[str, int]

    @property
    def peak(self) -> int:
        """Bytes at the worst moment: all that is held, and the largest of what passes."""
        return sum(self.held.values()) + max(self.passing.values(), default=0)

    @property
    def least(self) -> int:
        """Bytes at the worst moment when batches are taken in as many parts as is tried."""
        passing = {
            name: size // Parts.MOST if name == BATCH else size
            for name, size in self.passing.items()
        }
        return StageMemory(self.held, passing).peak

    @property
    def on_host(self) -> int:
        """Bytes on the host at the worst moment; the scene's own images are used in place."""
        return round(KEPT_BACK * (self.peak - sum(self.held.get(name, 0) for name in VIEWS)))


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
        checkpoint: the tensors of ``deformation.ckpt``.
        files: what each stage writes, by its name.
    """

    scene: Mapping[str, int]
    canonical: StageMemory
    deformation: StageMemory
    checkpoint: Mapping[str, int]
    files: Mapping[str, StageFiles]

    @property
    def gpu(self) -> int:
        """Bytes that a GPU needs for both stages, without the driver's own (about 0.5 GB)."""
        return max(self.canonical.peak, self.deformation.peak)

    @property
    def host(self) -> int:
        """Bytes on the host of a run that trains on a GPU.

        Scoring reads the checkpoint and builds its model: the fields are there twice.
        """
        return PROGRAM + sum(self.scene.values()) + 2 * sum(self.checkpoint.values())

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
    """
    box, frames = scene.bounds.motion or scene.bounds.box, len(scene.clock)
    voxels, final = round(canonical.side**3), deformation.sides[-1] ** 3
    with torch.device("meta"):  # shapes without memory
        field = architecture.radiance_field(box, voxels, voxels)
        motion = DeformationField(box, scene.clock, voxels=final)
    points = field.density.values.numel()
    grids = tensor_bytes(field.density) + tensor_bytes(field.color)
    decoder, displacements = tensor_bytes(field.decoder), tensor_bytes(motion)
    slices, rest = displacements // frames, grids + decoder + points
    growth = 0
    if len(deformation.sides) > 1:
        x, y, z = box.grid_shape(deformation.sides[-2] ** 3)
        # One direction after the other: the old grids of one stand beside the new of both.
        growth = frames * x * y * z * DISPLACEMENT
    static, dynamic = scene.static.train, scene.dynamic.train
    area = static.height * static.width
    frame_area = dynamic.height * dynamic.width * -(-len(dynamic) // frames)
    return Budget(
        scene=_sum([
            view_bytes(views)
            for capture in (scene.static, scene.dynamic)
            for views in (capture.train, capture.test)
        ]),
        canonical=StageMemory(
            held={
                **view_bytes(static),
                "pixels to draw from": len(static) * area * POOLED,
                "density and features": grids,
                "their gradients": grids,
                "their Adam moments": 2 * grids,
                "decoder, with gradients and moments": 4 * decoder,
                "a copy to go back to": grids + decoder,
                "occupancy": 2 * points,
            },
            passing={
                BATCH: max(
                    batch_bytes(canonical, k, architecture, box, step)
                    for k in range(len(canonical.phases))
                ),
                "an optimiser step": 2 * grids,
                "looking for what is occupied": SOUGHT * points,
            },
        ),
        deformation=StageMemory(
            held={
                **view_bytes(dynamic),
                "pixels to draw from": frame_area * POOLED,
                "density and features": grids,
                "decoder": decoder,
                "occupancy": 4 * points,
                f"displacements of {frames} frames, both ways": displacements,
                "gradients of one frame": slices,
                "Adam moments of one frame": 2 * slices,
                "a copy of one frame to go back to": slices,
            },
            passing={
                BATCH: motion_batch_bytes(
                    deformation.rays, samples_per_ray(box, voxels, architecture.planes, step),
                    architecture,
                ),
                "an optimiser step": 2 * slices,
                "looking for what is occupied": SOUGHT_WARPED * points,
                "growing the grids": growth,
            },
        ),
        checkpoint={
            "density and features": grids,
            "decoder": decoder,
            "occupancy": points,
            f"displacements of {frames} frames, both ways": displacements,
        },
        files={
            # With moments, and the share of the views of each voxel.
            "canonical": StageFiles(rest, rest + 2 * (grids + decoder) + 4 * points),
            "deformation": StageFiles(rest + displacements, rest + displacements + 2 * slices),
        },
    )


def tensor_bytes(module: nn.Module) -> int:
    """Bytes of a module's parameters and of the buffers that a checkpoint keeps."""
    kept = (v for v in module.state_dict().values() if isinstance(v, torch.Tensor))
    return sum(v.numel() * v.element_size() for v in kept)


def view_bytes(views: Views) -> dict[str, int]:
    """Bytes of N views by part: ``images``, and ``optical flow`` and ``depth`` if they have it."""
    parts = {"images": views.pixels.numel()}
    if views.flow is not None:
        parts["optical flow"] = 4 * views.flow.vectors.numel() + views.flow.valid.numel()
    if views.depth is not None:
        parts["depth"] = 4 * views.depth.numel()
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
    return round(MARCHED * samples + _color_bytes(architecture, searching) * decoded)


def motion_batch_bytes(rays: int, samples: float, architecture: Architecture) -> int:
    """About what a batch of the deformation stage takes, of ``rays`` with ``samples`` each."""
    met = rays * samples * (OCCUPIED if architecture.planes is None else 1.0)
    return round((MARCHED + WARPED) * met + _color_bytes(architecture, False) * DECODED * met)


def _color_bytes(architecture: Architecture, searching: bool) -> int:
    """Bytes of a sample whose colour is computed, with all that its gradient needs."""
    channels, width = (3, 0) if searching else (architecture.channels, architecture.width)
    return 4 * (6 * width + 24 * channels) + 400


def _sum(parts: list[dict[str, int]]) -> dict[str, int]:
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: sum(part.get(name, 0) for part in parts) for name in names}
