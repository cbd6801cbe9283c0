"""The deformation stage: dynamic views + the canonical field → how the scene moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from devrf.data.batch import background_color, gather_batch
from devrf.data.correspondence import previous_images
from devrf.data.pool import PixelPool, all_pixels
from devrf.errors import DevrfError
from devrf.fields.deformation import DeformationField
from devrf.fields.occupancy import Occupancy
from devrf.losses.composer import WeightedLoss
from devrf.losses.motion import MOTION_TERMS, MotionPrediction, total_variation_weight
from devrf.losses.photometric import visibility
from devrf.ops.adam import GridAdam
from devrf.ops.spans import span
from devrf.ops.total_variation import add_total_variation_gradient
from devrf.ops.trilinear import interpolate
from devrf.rendering.model import SceneModel, deformed_occupancy
from devrf.rendering.render import render
from devrf.scenes.scene import CaptureName, Views
from devrf.stages.checkpoint import Passport, Stored
from devrf.stages.flow_start import follow, start_from_tracks
from devrf.stages.progress import pack, unpack
from devrf.stages.ranks import share, take_from_first
from devrf.stages.schedules import DeformationPhase, DeformationSchedule
from devrf.stages.settings import DEFORMATION_LOSS, MotionSettings
from devrf.stages.stage import Phase, ScheduledStage
from devrf.stages.useful import meets_matter


@dataclass
class Visit:
    """What is at hand while one frame is visited.

    Attributes:
        backward: (X, Y, Z, 3) the frame's Δ_b, a leaf in the field's memory.
        forward: (X, Y, Z, 3) the frame's Δ_f, likewise.
        occupancy: where the frame's matter is.
        pools: the pixels to learn from; batches are drawn from each in turn.
    """

    backward: Tensor
    forward: Tensor
    occupancy: Occupancy
    pools: list[PixelPool]


class DeformationStage(ScheduledStage):
    """Learns the 4D deformation field of a scene whose canonical field is known (method §3).

    Frames are visited one after another, coarse to fine. Only the visited frame's two slices
    are trained; the canonical field and all other frames are frozen.
    """

    name: ClassVar[str] = "deformation"
    capture: ClassVar[CaptureName] = "dynamic"
    costly: ClassVar[tuple[str, ...]] = ("schedule.deformation.sides", "schedule.deformation.rays")

    def __init__(
        self,
        rest: Stored,
        schedule: DeformationSchedule | None = None,
        motion: MotionSettings | None = None,
        loss: Mapping[str, float] = DEFORMATION_LOSS,
        iterations_per_step: int = 10,
    ) -> None:
        """Build the stage; the defaults are the paper's for inward-facing scenes.

        Args:
            rest: what the canonical stage learned (``CanonicalStage.result()`` or
                ``load_checkpoint``); its fields are frozen.
            schedule: resolutions, iterations and frames.
            motion: learning rate and how batches are drawn.
            loss: weights of the loss terms; ``tv`` is the total variation of both fields.
            iterations_per_step: optimiser iterations in one Lightning step.
        """
        super().__init__(iterations_per_step)
        self.schedule = schedule or DeformationSchedule()
        self.motion = motion or MotionSettings()
        weights = dict(loss)
        self.tv = weights.pop("tv", 0.0)
        self.losses = WeightedLoss(MOTION_TERMS, weights)
        canonical, occupancy = rest.model.canonical, rest.model.occupancy
        model = SceneModel(
            canonical, occupancy, rest.model.settings, space=rest.model.space
        )
        self.scene_model = model.requires_grad_(False)
        self.architecture = rest.passport.architecture
        self.records = rest.passport.records
        placeholder = torch.zeros(2, 2, 2, 3, requires_grad=True)
        self._optimizer = GridAdam(
            [{"params": [placeholder], "lr": self.motion.learning_rate, "name": "motion"}]
        )
        self._visit: Visit | None = None
        self._previous: Tensor | None = None

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Present shape of the motion grids."""
        return self.field.shape

    @property
    def model(self) -> SceneModel:
        """The moving scene learned so far."""
        return self.scene_model

    @property
    def field(self) -> DeformationField:
        """The deformation field."""
        assert self.scene_model.deformation is not None, "the stage has not been set up"
        return self.scene_model.deformation

    @property
    def optimizer(self) -> GridAdam:
        """Adam over the visited frame's two slices."""
        return self._optimizer

    @property
    def total_iterations(self) -> int:
        """Iterations of all levels and frames."""
        return self.schedule.total(len(self.field.clock))

    def phase_at(self, iteration: int) -> Phase:
        """The schedule's phase."""
        return self.schedule.phase(iteration, len(self.field.clock))

    def learning_rate_factor(self, iteration: int) -> float:
        """The decay of the level that ``iteration`` belongs to."""
        return self.schedule.phase(iteration, len(self.field.clock)).learning_rate_factor

    def setup(self, stage: str) -> None:
        """Build the field at rest, at the coarsest resolution, in the canonical field's box."""
        super().setup(stage)
        if self.scene_model.deformation is None:
            self.scene_model.deformation = DeformationField(
                self.scene_model.canonical.box,
                self.scene.clock,
                voxels=self.schedule.sides[0] ** 3,
            )
        scale = self.scene_model.canonical.box.longest if self.motion.unit == "box" else 1.0
        self._optimizer.param_groups[0]["base_lr"] = self.motion.learning_rate * scale

    def enter(self, phase: Phase) -> None:
        """Go to the phase's frame: grow the grids if a level begins, fresh Adam."""
        assert isinstance(phase, DeformationPhase)
        previous, self.phase = self.phase, phase
        assert previous is None or isinstance(previous, DeformationPhase)
        if previous is not None and previous.level != phase.level:
            # What was visited shares the old grids' memory: let go of it first.
            self._visit = None
            self._optimizer.replace(0, [])
            self.field.resize(phase.side**3)
        views = self._device_views()
        if self._previous is None:
            self._previous = previous_images(views)
        if phase.carries:
            self.field.carry(phase.frame)
        if phase.level == 0 and self.motion.start == "flow" and views.flow is not None:
            self._follow_flow(views, phase.frame)
        backward, forward = self.field.slice(phase.frame)
        self._visit = Visit(backward, forward, self.scene_model.occupancy, [])
        self._optimizer.replace(0, [backward, forward])
        self._look_around()
        self._visit.pools = self._frame_pools(views, phase.frame)

    def _follow_flow(self, views: Views, frame: int) -> None:
        """Move the frame's slices to where the flow says the frame before has gone."""
        assert self._previous is not None
        clock = self.field.clock
        pool = all_pixels(views, self._images(views, frame))
        tracks = follow(
            self.scene_model, views, pool, self._previous, clock.times[frame - 1], self.generator
        )
        space = self.scene_model.space
        start_from_tracks(self.field, frame, tracks, views.cameras, space)
        # Each process has followed pixels of its own.
        take_from_first([self.field.to_canonical[frame], self.field.to_time[frame]])

    @property
    def visit(self) -> Visit:
        """The frame that is being visited."""
        assert self._visit is not None, "no phase has been entered"
        return self._visit

    def _device_views(self) -> Views:
        views: Views = self.trainer.datamodule.training_views(  # type: ignore[attr-defined]
            self.capture, self.device
        )
        return views

    def _warp(self, points: Tensor) -> Tensor:
        """Points of the visited frame → canonical space."""
        return points + interpolate(self.visit.backward, self._coords(points))

    def _unwarp(self, points: Tensor) -> Tensor:
        """Canonical points → the visited frame."""
        return points + interpolate(self.visit.forward, self._coords(points))

    def _unwarp_previous(self, points: Tensor) -> Tensor:
        """Canonical points → the frame before; the identity where that is frame 0."""
        assert isinstance(self.phase, DeformationPhase)
        if self.phase.frame == 1:
            return points
        frozen = self.field.to_time[self.phase.frame - 1]
        return points + interpolate(frozen, self._coords(points))

    def _coords(self, points: Tensor) -> Tensor:
        return self.field.box.to_grid(points, self.field.shape)

    @torch.no_grad()
    def _look_around(self) -> None:
        """Find where the visited frame's matter is under the present field."""
        self.visit.occupancy = deformed_occupancy(self.scene_model, self._warp)

    @torch.no_grad()
    def _frame_pools(self, views: Views, frame: int) -> list[PixelPool]:
        """The pixels to learn the frame from: a pool a batch can be drawn from, by turns."""
        images = self._images(views, frame)
        if len(images) == 0:
            raise DevrfError(f"dynamic training set: no image at frame {frame}")
        pools = [all_pixels(views, image[None]) for image in images]
        if self.motion.pixels == "useful":
            pools = [self._useful(views, pool) for pool in pools]
        if self.motion.views == "all":
            pools = [
                PixelPool(
                    torch.cat([pool.image for pool in pools]),
                    torch.cat([pool.flat for pool in pools]),
                )
            ]
        return pools

    def _images(self, views: Views, frame: int) -> Tensor:
        """The images (K,) of a frame, ascending."""
        return (self.field.clock.frames_of(views.times) == frame).nonzero()[:, 0]

    def _useful(self, views: Views, pool: PixelPool) -> PixelPool:
        """Pixels on the matte, or whose rays meet the frame's matter; all if there are none."""
        image = int(pool.image[0])
        kept = meets_matter(views.cameras, image, self.scene_model, self.visit.occupancy)
        if views.has_alpha:
            kept |= views.pixels[image, :, :, 3].flatten() > 0
        return PixelPool(pool.image[kept], pool.flat[kept]) if bool(kept.any()) else pool

    def loss(self, views: Views) -> tuple[Tensor, dict[str, Tensor]]:
        """Render a batch of the visited frame through its warp; compare images and motion."""
        assert isinstance(self.phase, DeformationPhase) and self._previous is not None
        since = self.iteration - self.phase.start
        if since and since % self.motion.occupancy_every == 0:
            with span("sampling"):
                self._look_around()
        space = self.scene_model.space
        with span("batch"):
            pool = self.visit.pools[self.iteration % len(self.visit.pools)]
            image, flat = pool.draw(share(self.schedule.rays), self.generator)
            background = background_color(self.scene.background, len(image), self.generator)
            batch = self.parts.of(gather_batch(views, image, flat, background, space))
        model = self.scene_model
        output = render(
            batch.rays, model.canonical, self.visit.occupancy, model.settings, batch.background,
            self._warp,
        )
        prediction = MotionPrediction(
            output, batch, self._unwarp, self._unwarp_previous, views.cameras, self._previous,
            space,
        )
        with span("losses"):
            total, terms = self.losses(prediction)
            return total, {**terms, **visibility(prediction)}

    def go_back(self, iteration: int, caution: float) -> None:
        """Go on from an earlier iteration of the present visit; look anew where matter is."""
        super().go_back(iteration, caution)
        self._look_around()

    @torch.no_grad()
    def add_gradients(self) -> None:
        """The total variation of the visited frame's slices, on all voxels."""
        if not self.tv:
            return
        weight = total_variation_weight(self.tv, max(self.field.shape), self.schedule.rays)
        for grid in (self.visit.backward, self.visit.forward):
            if grid.grad is None:
                grid.grad = torch.zeros_like(grid)
            add_total_variation_gradient(grid, grid.grad, weight)

    def at_hand(self) -> dict[str, Any]:
        """Where the visited frame's matter was last seen, and the pixels to learn from."""
        assert isinstance(self.phase, DeformationPhase)
        views, mask = self._device_views(), self.visit.occupancy.mask
        images, area = self._images(views, self.phase.frame), views.height * views.width
        return {
            "occupancy": pack(mask),
            "shape": list(mask.shape),
            "pixels": [pack(pool.mask(images, area)) for pool in self.visit.pools],
        }

    def take_up(self, phase: Phase, kept: dict[str, Any]) -> None:
        """Go on with the visit of ``phase``, the field being loaded."""
        assert isinstance(phase, DeformationPhase)
        views = self._device_views()
        self._previous = previous_images(views)
        images, area = self._images(views, phase.frame), views.height * views.width
        mask = unpack(kept["occupancy"], kept["shape"], self.device)
        self._visit = Visit(
            *self.field.slice(phase.frame),
            Occupancy(mask, self.scene_model.canonical.box),
            [
                PixelPool.of_mask(images, unpack(bits, (len(images), area), self.device))
                for bits in kept["pixels"]
            ],
        )
        self._optimizer.replace(0, [self.visit.backward, self.visit.forward])

    def passport(self) -> Passport:
        """What the checkpoint is, and how to build its model."""
        return Passport(
            scene=self.scene.name,
            fingerprint=self.scene.fingerprint,
            architecture=self.architecture,
            settings=self.scene_model.settings,
            space=self.scene_model.space,
            records={**self.records, "deformation": self.record},
            made_with=self.made_with,
            complete=self.iteration >= self.total_iterations,
        )
