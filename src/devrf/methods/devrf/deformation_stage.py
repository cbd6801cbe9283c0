"""The deformation stage: the dynamic capture and the canonical field → how the scene moves."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, get_args

from torch import Tensor

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.flow import previous_images
from devrf.engine.grid_adam import GridAdam
from devrf.engine.stage import Stage, Terms
from devrf.errors import DevrfError, expect
from devrf.geometry.space import WorldSpace
from devrf.methods.batch import gather_batch
from devrf.methods.devrf.active_frame import ActiveFrame
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.deformation_loss import DeformationLoss
from devrf.methods.devrf.deformation_schedule import (
    GROWN,
    LEVELS,
    VISITS,
    DeformationPhase,
    DeformationSchedule,
    Visits,
)
from devrf.methods.devrf.extension import DeformationContext, Extension
from devrf.methods.devrf.frame_store import FrameField
from devrf.methods.devrf.losses import DeformationPrediction, FlowMean, batch_loss
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.pixel_pools import frame_pools, pixels_for_epochs
from devrf.methods.devrf.plans import DeformationPlan
from devrf.methods.devrf.settings import DEFORMATION_LOSS, VisitSettings
from devrf.methods.devrf.volume_rendering import possible_occupancy, render
from devrf.rendering.output import ColorResidual
from devrf.scenes.scene import CaptureName, Views
from devrf.system.profiling import span

log = logging.getLogger(__name__)

# The longest edge in world units of the box of the robot, on which the loss's weights were chosen.
USUAL_EDGE = 2.3
# Where world units are so many times smaller or larger, the user is told.
FAR_FROM_USUAL = 5.0


class DeformationStage(Stage):
    """Learns from the dynamic views how the scene deforms (docs/method.md#deformation-stage).

    Coarse to fine, frames are learned one after another. Only the two slices of the present frame
    are trained, and what extensions add; all else is frozen.

    Attributes:
        scene_model: the canonical field, its occupancy, and how it deforms.
        settings: levels, iterations and rays, as configured.
        schedule: the visits to the scene's frames.
        visit: learning rate and how batches are drawn.
        deformation_loss: the loss terms, and their weights at each level.
        context: model, data, optimiser and active frame, as extensions see them.
    """

    scene_model: DeVRFModel
    schedule: Visits
    context: DeformationContext
    phase: DeformationPhase | None
    name = "deformation"
    capture: CaptureName = "dynamic"
    rate_keys = "schedule.visit.learning_rate or the weights of loss.deformation"
    plan = DeformationPlan

    def __init__(
        self,
        earlier: LoadedCheckpoint,
        schedule: DeformationSchedule | None = None,
        visit: VisitSettings | None = None,
        loss: Mapping[str, float] = DEFORMATION_LOSS,
        flow_mean: FlowMean = "samples",
        extensions: Mapping[str, Extension] | None = None,
        iterations_per_step: int = 10,
    ) -> None:
        """Build the stage; the defaults are the paper's for inward-facing scenes.

        Args:
            earlier: the result of the canonical stage; its fields are frozen.
            schedule: resolutions, iterations and frames.
            visit: learning rate and how batches are drawn.
            loss: weights of the loss terms; ``tv`` is the total variation of both fields.
            flow_mean: whether the flow loss is a mean over rays or samples (docs/method.md#flow).
            extensions: additions beyond the paper, by name.
            iterations_per_step: optimiser iterations in one Lightning step.
        """
        super().__init__(iterations_per_step)
        self.settings = schedule or DeformationSchedule()
        self.visit = visit or VisitSettings()
        expect(flow_mean in get_args(FlowMean), "loss.flow_mean", "rays or samples", flow_mean)
        self.flow_mean = flow_mean
        self.extensions = tuple((extensions or {}).values())
        self.deformation_loss = DeformationLoss(loss, self.extensions, self.settings)
        canonical = earlier.model.train()
        self.scene_model = DeVRFModel(
            canonical.architecture,
            canonical.canonical,
            canonical.occupancy,
            canonical.settings,
            space=canonical.space,
        ).requires_grad_(False)
        self.provenance.earlier_records = earlier.metadata.records
        rate = self.visit.learning_rate
        self.optimizer = GridAdam(
            [{"params": [], "lr": rate, "base_lr": rate, "name": "displacements"}]
        )
        # The state holds what the active frame has learned.
        self.register_state_dict_pre_hook(  # type: ignore[no-untyped-call]
            lambda *_: self._write_back()
        )
        # The phase's state where a fit ended before the schedule.
        self._left: dict[str, Any] = {}

    def iterate(self, views: Views) -> Terms:
        """Learn the present frame from one batch (docs/method.md#deformation-stage)."""
        frame = self.active
        assert frame is not None
        model = self.scene_model
        field = self.field
        with span("batch"):
            image, flat = self.draw()
            background = self.background(image, self.generator)
            per_pixel = model.settings.rays_per_pixel
            batch = gather_batch(views, image, flat, background, model.space, per_pixel)
        output = render(
            batch.rays,
            model.canonical,
            frame.occupancy,
            model.settings,
            batch.background,
            backward_warp=field.warp_by(frame.backward),
            color_residual=self._color_residual(frame),
        )
        # Before frame 1 nothing has moved.
        previous = frame.previous_forward if frame.number > 1 else None
        with span("losses"):
            prediction = DeformationPrediction(
                output=output,
                batch=batch,
                forward_warp=field.warp_by(frame.forward),
                previous_forward_warp=field.warp_by(previous),
                cameras=views.cameras,
                previous_image=self.previous_images,
                forward_slice=frame.forward,
                box=field.box,
                space=model.space,
                flow_mean=self.flow_mean,
            )
            loss, terms = batch_loss(prediction, self.deformation_loss.terms, self.context.weights)
        self.optimise(loss)
        return {"loss": loss.detach(), **terms}

    def draw(self) -> tuple[Tensor, Tensor]:
        """Random pixels of the frame, of its views in turn or of all.

        The image of each (P,), and its row-major number there (P,), int64.
        """
        frame = self.active
        phase = self.phase
        assert frame is not None and phase is not None
        per_pixel = self.scene_model.settings.rays_per_pixel
        most = None
        if self.visit.epochs is not None:
            pixels = sum(len(pool) for pool in frame.pools)
            iterations = round((phase.stop - phase.start) / self.position.schedule_scale)
            most = pixels_for_epochs(self.visit.epochs, pixels, iterations)
        pool = frame.pools[self.position.iterations_done % len(frame.pools)]
        drawn = self.batch_size.rays(self.settings.rays // per_pixel, most)
        return pool.draw(drawn, self.generator)

    @property
    def field(self) -> DeformationField:
        """The deformation field; what the active frame learns may not be written back yet."""
        assert self.scene_model.deformation is not None, "the stage has not been set up"
        return self.scene_model.deformation

    @cached_property
    def previous_images(self) -> Tensor:
        """(N,) for each image the same view's image one frame earlier; itself without one."""
        return previous_images(self.context.views)

    @property
    def active(self) -> ActiveFrame | None:
        """The frame that is trained; None before the first, and after the last."""
        return self.context.active if hasattr(self, "context") else None

    def setup(self, stage: str) -> None:
        """Build a field of zeros at the coarsest resolution; refuse a scene without motion."""
        super().setup(stage)
        if not self.scene.moves:
            raise DevrfError(f"{self.scene.name}: is at rest; the canonical stage is all it takes")
        if self.scene.dynamic.train.by_moving_camera and self.deformation_loss.leave_out("flow"):
            log.info("the camera moves, and so does all that it sees: the flow loss is left out")
        # Where a stage is only scored, it can still be saved, and go on from there.
        if stage == "fit" or not hasattr(self, "context"):
            self.phase = None
            self._left = {}
            # No frame is active: what is loaded next is checked out when its phase is restored.
            self.context = DeformationContext(
                model=self.scene_model,
                datamodule=self.datamodule,
                settings=self.settings,
                optimizer=self.optimizer,
                generator=self.generator,
                background=self.background,
                batch_size=self.batch_size,
            )
        if self.scene_model.deformation is None:
            self._build_field()
            self.schedule = Visits(self.settings, len(self.field.clock))
            for extension in self.extensions:
                extension.setup(self.context)
        edge = self.field.box.longest
        # Other spaces have a unit of their own.
        unit = edge / USUAL_EDGE if isinstance(self.scene_model.space, WorldSpace) else 1.0
        if self.visit.unit == "box":
            self.optimizer.param_groups[0]["base_lr"] = self.visit.learning_rate * edge
            self.deformation_loss.unit = unit
            # Gradients by lengths are as much smaller.
            self.optimizer.param_groups[0]["eps"] = self.optimizer.defaults["eps"] / unit
        elif not 1 / FAR_FROM_USUAL < unit < FAR_FROM_USUAL:
            log.warning(
                "the box has edges of %.3g world units, and schedule.visit.unit=world is meant for "
                "some %g: little may move; give schedule.visit.unit=box, or scale the cameras",
                edge,
                USUAL_EDGE,
            )

    def _build_field(self) -> None:
        """The field over the canonical field's box; in contracted space, over the inner box."""
        model = self.scene_model
        box = model.space.inner(model.box)
        voxels, planes = self.settings.grid(0)
        model.deformation = DeformationField(
            box, self.scene.clock, voxels, planes, zero_outside_box=box != model.box
        )
        device = self.trainer.strategy.root_device
        model.deformation.frames.keep(
            self.visit.store,
            device,
            shape=box.grid_shape(*self.settings.grid(-1)),
            half=self.visit.stored_half(device),
        )

    def _color_residual(self, frame: ActiveFrame) -> ColorResidual | None:
        """The addition to the colours' logits by an extension; None: nothing."""
        residuals = (extension.color_residual(frame) for extension in self.extensions)
        return next((residual for residual in residuals if residual is not None), None)

    def prepare(self) -> None:
        """Weigh the terms; update the frame's occupancy every ``occupancy_every`` iterations."""
        phase = self.phase
        assert phase is not None
        share = phase.share(self.position.iteration)
        self.context.weights = self.deformation_loss.weights_at(phase.level, share)
        every = max(1, round(self.visit.occupancy_every * self.position.schedule_scale))
        if self.position.is_due(every, phase.start):
            with span("sampling"):
                self._update_occupancy()

    def enter(self, phase: DeformationPhase) -> None:
        """Go to the phase's frame: grow the grids if a level begins, fresh Adam if asked for."""
        previous = self.phase
        self.phase = phase
        self._write_back()
        self.events[VISITS] += 1
        self.events[LEVELS] += previous is None or previous.level != phase.level
        if previous is not None and previous.level != phase.level:
            self._free()
            self.field.resize(*self.settings.grid(phase.level))
            self.events[GROWN] += previous.side != phase.side
        if phase.init_from_previous:
            self.field.frames.copy_previous(phase.frame)
        for extension in self.extensions:
            extension.initialise(self.context, phase)
        frame = self._activate(phase)
        self._update_occupancy()
        frame.pools = frame_pools(
            self.context.views,
            frame.number,
            self.scene_model,
            frame.occupancy,
            occupied_only=self.visit.pixels == "occupied",
            join_views=self.visit.views == "all",
        )

    def _free(self) -> None:
        """Free the memory of the active frame, and that of all that refers to it."""
        self.context.active = None
        for group in range(len(self.optimizer.param_groups)):
            self.optimizer.replace(group, [])

    def _activate(self, phase: DeformationPhase) -> ActiveFrame:
        """Check out the phase's frame."""
        frame = self.active
        if frame is None:
            frame = self._allocate(phase)
        elif self.visit.adam_state != "carried" or phase.level == 0:
            self.optimizer.forget()
        frame.check_out(phase.frame)
        side = f"schedule.deformation.levels.{phase.level + 1}.side"
        self.batch_size.keys = (side, "schedule.deformation.rays")
        return frame

    def _allocate(self, phase: DeformationPhase) -> ActiveFrame:
        """Make memory for a frame at the fields' resolutions, and let Adam learn it."""
        self._free()
        context = self.context
        level = phase.level
        further: dict[str, FrameField] = {}
        for extension in self.extensions:
            further |= extension.frame_fields(context, level)
        frame = ActiveFrame(self.field.frames, self.scene_model.occupancy, further)
        context.active = frame
        context.weights = self.deformation_loss.weights_at(level)
        smoothing = self.deformation_loss.smoothing(level, self.field.shape)
        bound = self.deformation_loss.unit
        self.optimizer.replace(0, frame.slices, smoothing=smoothing, bound=bound)
        for extension in self.extensions:
            extension.begin_level(context, level)
        return frame

    def _update_occupancy(self) -> None:
        """Find the occupancy of the active frame under its present displacements."""
        frame = self.active
        assert frame is not None
        warp = self.field.warp_by(frame.backward)
        frame.occupancy.refill(possible_occupancy(self.scene_model.occupancy, warp))

    def remember(self) -> Callable[[], None]:
        """Nothing: the frame's occupancy is found anew."""
        return self._update_occupancy

    def _write_back(self) -> None:
        """Copy what was learned of the active frame into the fields; learning may go on."""
        if self.active is not None:
            self.active.write_back()

    def current_model(self) -> DeVRFModel:
        """The moving scene, the active frame written back."""
        self._write_back()
        return self.scene_model

    def on_train_end(self) -> None:
        """Write the last frame back; a file that is written later still holds the way on."""
        self._write_back()
        if not self.is_complete:
            self._left = self.phase_state()
        self.context.active = None
        super().on_train_end()

    def phase_state(self) -> dict[str, Any]:
        """The state of the active frame; nothing once all is learned."""
        if self.active is None:
            return self._left
        exact = self.visit.stored_half(self.device)
        return self.active.state(self.context.views, exact=exact)

    def restore(self, phase: DeformationPhase, state: dict[str, Any]) -> None:
        """Go on with the frame of ``phase``, the field being loaded."""
        frame = self._activate(phase)
        if state:
            frame.load_state(state, self.context.views)
