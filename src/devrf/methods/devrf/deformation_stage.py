"""The deformation stage: the dynamic capture and the canonical field → how the scene moves."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.batch import Pixels, all_pixels
from devrf.data.flow import previous_images
from devrf.engine.batches import frame_pools, images_of
from devrf.engine.convergence import Convergence
from devrf.engine.ddp import broadcast
from devrf.engine.graphs import Graphs
from devrf.engine.loop import ParallelBatch
from devrf.engine.stage import Phase
from devrf.errors import DevrfError
from devrf.methods.devrf.active_frame import ActiveFrames
from devrf.methods.devrf.appearance import AppearanceSettings
from devrf.methods.devrf.appearance_learning import AppearanceLearning
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.deformation_schedule import DeformationPhase, DeformationSchedule
from devrf.methods.devrf.deformed_occupancy import deformed_occupancy
from devrf.methods.devrf.elastic import occupied_cells
from devrf.methods.devrf.flow_initialisation import start_from_tracks
from devrf.methods.devrf.flow_tracks import FlowTracks
from devrf.methods.devrf.frame_memory import rest_on_host
from devrf.methods.devrf.losses import (
    FLOW_TERMS,
    MOTION_TERMS,
    PRIORS,
    VISIBILITY,
    FlowMean,
    MotionGrid,
    MotionPrediction,
    total_variation_weight,
)
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.refinement import Refinement, RefinementPhase, RefinementSettings
from devrf.methods.devrf.settings import (
    APPEARANCE_LOSS,
    DEFORMATION_LOSS,
    FINE_LOSS,
    MotionSettings,
    Precision,
)
from devrf.methods.devrf.voxel_stage import VoxelStage
from devrf.methods.devrf.weighted_loss import WeightedLoss
from devrf.ops.adam import GridAdam
from devrf.scenes.scene import CaptureName, Views
from devrf.system.profiling import span

log = logging.getLogger(__name__)


class DeformationStage(VoxelStage):
    """Learns from the dynamic views how the scene deforms (docs/method.md#deformation-stage).

    Coarse to fine (docs/method.md#coarse-to-fine), frames are learned one after another, or several
    in parallel, each from batches of its own. Only their two slices are trained, and how their
    colours change if that is asked for; the canonical field and all other frames are frozen. A last
    phase may refine the canonical field (docs/method.md#refinement).
    """

    schedule: DeformationSchedule
    name = "deformation"
    capture: CaptureName = "dynamic"
    rate_keys = "schedule.motion.learning_rate or the weights of loss.deformation"

    def __init__(
        self,
        rest: LoadedCheckpoint,
        schedule: DeformationSchedule | None = None,
        motion: MotionSettings | None = None,
        loss: Mapping[str, float] = DEFORMATION_LOSS,
        flow_mean: FlowMean = "rays",
        iterations_per_step: int = 10,
        graphs: Graphs = "auto",
        decoder_precision: Precision = "auto",
        appearance: AppearanceSettings | None = None,
        appearance_loss: Mapping[str, float] = APPEARANCE_LOSS,
        refinement: RefinementSettings | None = None,
        refinement_loss: Mapping[str, float] = FINE_LOSS,
    ) -> None:
        """Build the stage; the defaults are the paper's for inward-facing scenes.

        Args:
            rest: what the canonical stage learned (``CanonicalStage.result()`` or
                ``load_checkpoint``); its fields are frozen.
            schedule: resolutions, iterations and frames.
            motion: learning rate and how batches are drawn.
            loss: weights of the loss terms; ``tv`` is the total variation of both fields.
            flow_mean: what the flow loss is a mean over (docs/method.md#flow).
            iterations_per_step: optimiser iterations in one Lightning step.
            graphs: whether a GPU replays iterations from CUDA graphs: ``auto`` where it can.
            decoder_precision: what the colour network computes in; ``auto``: ``bfloat16`` on a
                GPU that multiplies it.
            appearance: whether and how the change of colours is learned.
            appearance_loss: weights of the squared residuals, ``residual``, and of their total
                variation, ``tv``.
            refinement: how the canonical field learns on at the end.
            refinement_loss: weights of the photometric terms that it learns from.
        """
        super().__init__(iterations_per_step, graphs, decoder_precision)
        self.schedule = schedule or DeformationSchedule()
        self.motion = motion or MotionSettings()
        weights = dict(loss)
        self.tv = weights.pop("tv", 0.0)
        chosen = appearance or AppearanceSettings()
        self.appearance = AppearanceLearning(chosen, self.schedule, appearance_loss)
        weights.update(self.appearance.weights)
        terms = MOTION_TERMS | {"flow": FLOW_TERMS[flow_mean]}
        self.losses = WeightedLoss(terms, weights, VISIBILITY)
        # What the schedule's factors are factors of.
        self._weights = dict(self.losses.weights)
        self._check_factors()
        still = rest.model
        fields = still.canonical, still.occupancy
        self.refinement = Refinement(self, refinement or RefinementSettings(), refinement_loss)
        if self.refinement.settings.iterations:
            fields = copy.deepcopy(fields)  # what rest holds stays as it is
        self.scene_model = DeVRFModel(
            still.architecture, *fields, still.settings, space=still.space
        ).requires_grad_(False)
        self.earlier_records = rest.metadata.records
        placeholder = torch.zeros(2, 2, 2, 3, requires_grad=True)
        self._optimizer = GridAdam(
            [{"params": [placeholder], "lr": self.motion.learning_rate, "name": "motion"}]
        )
        self.active = ActiveFrames(self)
        self._convergence = Convergence()
        self._previous_images: Tensor | None = None
        self._tracks: FlowTracks | None = None
        # The cells of the motion grid that hold matter at rest; None where no loss asks.
        self._matter: Tensor | None = None

    @property
    def field(self) -> DeformationField:
        """The deformation field; the active frames' part of it may not be written back yet."""
        assert self.scene_model.deformation is not None, "the stage has not been set up"
        return self.scene_model.deformation

    @property
    def _follows_flow(self) -> bool:
        """Whether there is flow that tells how the scene moves, not the camera."""
        recorded = self.scene.dynamic.train
        return recorded.flow is not None and not recorded.by_moving_camera

    @property
    def total_iterations(self) -> int:
        """Iterations of all levels and frames, and of the refinement."""
        return self.schedule.total(len(self.field.clock)) + self.refinement.settings.iterations

    @property
    def resolution(self) -> tuple[int, ...]:
        """Present shape of the motion grids."""
        return self.field.shape

    @property
    def optimizer(self) -> GridAdam:
        """Adam over the two slices of each active frame."""
        return self._optimizer

    def phase_at(self, iteration: int) -> DeformationPhase | RefinementPhase:
        """The schedule's phase, or the refinement after the last."""
        frames = len(self.field.clock)
        last = self.schedule.total(frames)
        if iteration >= last and self.refinement.settings.iterations:
            return self.refinement.phase(last)
        return self.schedule.phase(iteration, frames)

    def learning_rate_factor(self, iteration: int) -> float:
        """Of the iteration's level, and of its visit (docs/method.md#motion-learning-rate)."""
        phase = self.phase_at(iteration)
        if isinstance(phase, RefinementPhase):
            return phase.learning_rate_factor(iteration)
        share = (iteration - phase.start) / (phase.stop - phase.start)
        return phase.learning_rate_factor * math.pow(phase.lr_final_factor, share)

    def setup(self, stage: str) -> None:
        """Build the field at rest, at the coarsest resolution.

        It lives in the canonical field's box; in contracted space in the inner box, and what is
        outside stays where it is.

        Raises:
            DevrfError: the scene is at rest.
        """
        super().setup(stage)
        if not self.scene.moves:
            raise DevrfError(
                f"{self.scene.name}: is at rest, so there is no motion to learn; the canonical "
                "stage is all that it takes"
            )
        self._leave_out_camera_flow()
        model, motion = self.scene_model, self.motion
        if model.deformation is None:
            voxels = self.schedule.levels[0].side ** 3
            box = model.space.inner(model.box)
            model.deformation = DeformationField(
                box, self.scene.clock, voxels=voxels, still_outside=box != model.box
            )
            self.field.frames.offload(
                on_host=rest_on_host(self.trainer, model, self.schedule, motion),
                half=motion.rests_half(self.trainer.strategy.root_device),
            )
            # Before the clock of training starts.
            self.field.frames.reserve(box.grid_shape(self.schedule.levels[-1].side ** 3))
            recorded = self.scene.dynamic.train
            self.appearance.setup(model, self.field.clock, self._optimizer, recorded)
            if self.refinement.settings.iterations:
                self.refinement.add_groups()
        scale = self.field.box.longest if motion.unit == "box" else 1.0
        self._optimizer.param_groups[0]["base_lr"] = motion.learning_rate * scale

    def _leave_out_camera_flow(self) -> None:
        """No loss for a moving camera's flow (docs/method.md#flow-of-a-moving-camera)."""
        if self.scene.dynamic.train.flow is None or self._follows_flow:
            return
        if self.motion.init_from != "previous" or self._weights.get("flow"):
            log.info(
                "the camera moves, and so does all that it sees: frames start where the ones "
                "before them ended, and the flow loss is left out"
            )
        self._weights["flow"] = 0.0

    def enter(self, phase: Phase) -> None:
        """Go to the phase's frames: grow the grids if a level begins, fresh Adam if asked for."""
        assert isinstance(phase, DeformationPhase | RefinementPhase)
        previous, self.phase = self.phase, phase
        self.active.write_back()
        if isinstance(phase, RefinementPhase):
            self.refinement.grow()
            self._begin_refinement()
            return
        if isinstance(previous, DeformationPhase) and previous.level != phase.level:
            self._allocate(0)
            self._tracks = None
            self.field.resize(phase.side**3)
        self._initialise(phase)
        carried = self.motion.adam_state == "carried" and phase.level > 0
        if len(self.active) == len(phase.frames) and not carried:
            for group in range(len(self._optimizer.param_groups)):
                self._optimizer.forget(group)
        self.activate(phase)
        self._prefetch_after(phase)
        self.update_occupancy()
        for frame in self.active:
            frame.pools = frame_pools(
                self.views,
                frame.number,
                self.scene_model,
                frame.occupancy,
                occupied_only=self.motion.pixels == "occupied",
                join_views=self.motion.views == "all",
            )

    def _begin_refinement(self) -> None:
        """Free what the frames were learned with, and refine the canonical field."""
        self.active.close()
        self.refinement.begin(self.views, occupied_only=self.motion.pixels == "occupied")

    def activate(self, phase: DeformationPhase) -> None:
        """Check out the phase's frames, with memory for them."""
        if len(self.active) != len(phase.frames):
            self._allocate(len(phase.frames))
        self.active.check_out(phase.frames)
        self._convergence.reset()

    def _allocate(self, count: int) -> None:
        """Make memory for ``count`` active frames at the field's present resolution."""
        # The memory of the frames before is freed first.
        self.loop.release()
        assert isinstance(self.phase, DeformationPhase)
        appearance = self.appearance.at_level(self.scene_model, self.phase.level)
        fields = self.field, self.scene_model.occupancy, appearance
        self.active.allocate(0, *fields)
        for group in range(len(self._optimizer.param_groups)):
            self._optimizer.replace(group, [])
        self.active.allocate(count, *fields)
        self._weigh(self.phase.level)
        self._matter = None
        if count and any(self.losses.weights.get(name) for name in PRIORS):
            occupancy = self.scene_model.occupancy
            self._matter = occupied_cells(occupancy, self.field.box, self.field.shape)
        tv = self.tv * self.schedule.weight_factor("tv", self.phase.level)
        smoothing = total_variation_weight(tv, max(self.field.shape), self.schedule.rays)
        learned = [tensor for frame in self.active for tensor in frame.slices]
        self._optimizer.replace(0, learned, smoothing=smoothing)
        residuals = [frame.residual for frame in self.active if frame.residual is not None]
        self.appearance.give_parameters(self._optimizer, residuals, self.phase.level)
        if len(self.active):
            static_shape = self.static_shape(self.scene_model.canonical.density.values)
            parameters = [frame.learned for frame in self.active]
            self.bind(self.schedule.rays, parameters, static_shape=static_shape)

    def _weigh(self, level: int) -> None:
        """Give each term its weight at ``level``."""
        by = self.schedule.weight_factor, self.appearance.weight_factor
        weights = {
            name: weight * math.prod(factor(name, level) for factor in by)
            for name, weight in self._weights.items()
        }
        self.losses = replace(self.losses, weights=weights)

    def _check_factors(self) -> None:
        given = {
            **{
                f"deformation.levels.{number}.weight_factors": (
                    level.weight_factors,
                    {*MOTION_TERMS, "tv"},
                )
                for number, level in enumerate(self.schedule.levels, 1)
            },
            "appearance.loss_scale_if_color_drift": (
                self.appearance.settings.loss_scale_if_color_drift,
                set(MOTION_TERMS),
            ),
        }
        for key, (factors, known) in given.items():
            for name in factors:
                if name not in known:
                    raise DevrfError(
                        f"schedule.{key}: {name} is no term of loss.deformation; the "
                        f"terms are {', '.join(sorted(known))}"
                    )

    def _initialise(self, phase: DeformationPhase) -> None:
        """Start each frame from the one before it; along the observed flow, if asked to."""
        self.appearance.initialise(self.scene_model, phase)
        for number in phase.frames:
            if phase.init_from_previous:
                self.field.frames.copy_previous(number)
            if self._starts_along_flow(phase):
                views, model = self.views, self.scene_model
                pool = all_pixels(views, images_of(views, number))
                # A visit's first frame has its number: the visits before have learned as many.
                learned = phase.frames[0]
                tracks = self.tracks.follow(number, pool, self.generator, learned=learned)
                seen = tracks, views.cameras, model.space
                start_from_tracks(self.field, number, *seen, capturer=self.loop.capturer())
                # Each process has followed pixels of its own.
                broadcast([self.field.to_canonical[number], self.field.to_time[number]])

    def _starts_along_flow(self, phase: DeformationPhase) -> bool:
        asked = self.motion.init_from != "previous" and self._follows_flow
        return asked and phase.level == 0 and phase.has_previous

    def _prefetch_after(self, phase: DeformationPhase) -> None:
        """Begin to fetch the next phase's frames, unless they change before it begins."""
        following = self.phase_at(phase.stop)
        if isinstance(following, RefinementPhase):
            return
        changed = following.init_from_previous or self._starts_along_flow(following)
        if following.level == phase.level and following != phase and not changed:
            self.field.frames.prefetch(following.frames)

    def current_model(self) -> DeVRFModel:
        """The moving scene, the active frames written back."""
        self.active.write_back()
        return self.scene_model

    def on_train_end(self) -> None:
        """Write the last frames back."""
        self.active.close()
        self.refinement.end()
        super().on_train_end()

    @property
    def views(self) -> Views:
        """The dynamic training views, on the stage's device."""
        return self.training_views(self.capture)

    @property
    def tracks(self) -> FlowTracks:
        """Follows the training views' pixels back, at the coarsest level."""
        if self._tracks is None:
            seen = self.scene_model, self.views, self.previous_images
            self._tracks = FlowTracks(*seen, by_color=self.motion.init_from == "tracks")
        return self._tracks

    @property
    def previous_images(self) -> Tensor:
        """(N,) for each image the same view's image one frame earlier; itself without one."""
        if self._previous_images is None:
            self._previous_images = previous_images(self.views)
        return self._previous_images

    def update_occupancy(self) -> None:
        """Find the occupancy of each active frame under its present displacements."""
        model = self.scene_model
        for frame in self.active:
            frame.occupancy.refill(deformed_occupancy(model.occupancy, model.canonical, frame.warp))

    def prepare(self) -> None:
        """Update the frames' occupancy every ``occupancy_every`` iterations."""
        assert self.phase is not None
        since = self.iteration - self.phase.start
        if since and since % self.motion.occupancy_every == 0:
            with span("sampling"):
                self.update_occupancy()

    def draw(self, batch: ParallelBatch) -> Pixels:
        """Random pixels of the batch's frame, of its views in turn or of all."""
        if isinstance(self.phase, RefinementPhase):
            return self.refinement.draw()
        pools = self.active[batch.number].pools
        return self.draw_pixels(pools[self.iteration % len(pools)])

    @property
    def view_cycle(self) -> int:
        """As many as there are pools, which batches are drawn from in turn."""
        if isinstance(self.phase, RefinementPhase):
            return 1
        return max(len(frame.pools) for frame in self.active)

    def loss(
        self, batch: ParallelBatch, views: Views, pixels: Pixels
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Render a batch of the frame through its warp; compare images and motion."""
        if isinstance(self.phase, RefinementPhase):
            return self.refinement.loss(views, pixels)
        frame, capacity, grid = self.active[batch.number], batch.capacity, None
        if self._matter is not None:
            grid = MotionGrid(frame.forward, frame.box, self._matter)
        prediction = MotionPrediction(
            *self.render_pixels(
                views, pixels, frame.occupancy, capacity, frame.warp, frame.appearance
            ),
            frame.unwarp,
            frame.unwarp_previous(always_interpolate=capacity is not None),
            views.cameras,
            self.previous_images,
            self.scene_model.space,
            grid,
        )
        with span("losses"):
            return self.losses(prediction)

    def converged(self, losses: Tensor) -> bool:
        """Whether each active frame's loss has stopped falling, if the schedule asks for that."""
        least = self.motion.min_rel_improvement
        if least is None or isinstance(self.phase, RefinementPhase):
            return False
        return self._convergence.converged(losses, least)

    def rollback(self, iteration: int, lr_scale: float) -> None:
        """Go on from an earlier iteration of the present frames, with an occupancy found anew."""
        super().rollback(iteration, lr_scale)
        self._convergence.reset()
        self.update_occupancy()

    @property
    def memory_keys(self) -> tuple[str, ...]:  # type: ignore[override]
        """Grid sizes and rays; how many frames are learned together, if there are several."""
        levels, phase = len(self.schedule.levels), self.phase
        number = phase.level + 1 if isinstance(phase, DeformationPhase) else levels
        level = f"schedule.deformation.levels.{number}"
        keys = (f"{level}.side", "schedule.deformation.rays")
        return (*keys, f"{level}.parallel_frames") if len(self.active) > 1 else keys

    def phase_state(self) -> dict[str, Any]:
        """The state of each active frame, and its losses so far."""
        area = self.views.height * self.views.width
        exact = self.motion.rests_half(self.device)
        return {
            "frames": [
                frame.state(images_of(self.views, frame.number), area, exact=exact)
                for frame in self.active
            ],
            "convergence": self._convergence.state(),
        }

    def restore(self, phase: Phase, kept: dict[str, Any]) -> None:
        """Go on with the frames of ``phase``, the field being loaded."""
        if isinstance(phase, RefinementPhase):
            self._begin_refinement()
            return
        assert isinstance(phase, DeformationPhase)
        self.activate(phase)
        views = self.views
        for frame, state in zip(self.active, kept["frames"], strict=True):
            frame.load_state(state, images_of(views, frame.number), views.height * views.width)
        self._convergence.load_state(kept["convergence"])
