"""The deformation stage: dynamic views + the canonical field → how the scene moves."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from devrf.checkpoints.bits import pack_bits, unpack_bits
from devrf.checkpoints.checkpoint import CheckpointMetadata, LoadedCheckpoint
from devrf.data.batch import Pixels, background_color, gather_batch
from devrf.data.correspondence import previous_images
from devrf.data.pool import PixelPool, all_pixels, wanted_pixels
from devrf.engine.ddp import broadcast, share
from devrf.engine.graphs import Graphs
from devrf.engine.parallel_batch import ParallelBatch
from devrf.engine.stage import Phase, ScheduledStage
from devrf.errors import DevrfError
from devrf.methods.devrf.active_frame import ActiveFrame
from devrf.methods.devrf.convergence import settled
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.flow_initialisation import follow, start_from_tracks
from devrf.methods.devrf.frame_memory import fits_on_device
from devrf.methods.devrf.model import SceneModel, deformed_occupancy
from devrf.methods.devrf.motion_losses import MOTION_TERMS, MotionPrediction, total_variation_weight
from devrf.methods.devrf.photometric_losses import visibility
from devrf.methods.devrf.pixel_selection import rays_hit_occupied
from devrf.methods.devrf.schedules import DeformationPhase, DeformationSchedule
from devrf.methods.devrf.settings import DEFORMATION_LOSS, MotionSettings, Precision
from devrf.methods.weighted_loss import WeightedLoss
from devrf.ops.adam import GridAdam
from devrf.rendering.occupancy import Occupancy
from devrf.scenes.scene import CaptureName, Views
from devrf.system.profiling import span

log = logging.getLogger(__name__)


class DeformationStage(ScheduledStage):
    """Learns the 4D deformation field of a scene whose canonical field is known (method §3).

    Frames are visited one after another, or several side by side, coarse to fine. Only their two
    slices are trained; the canonical field and all other frames are frozen. Frames that are
    visited together learn as if each were alone: each has a lane of its own.
    """

    name: ClassVar[str] = "deformation"
    capture: ClassVar[CaptureName] = "dynamic"

    def __init__(
        self,
        rest: LoadedCheckpoint,
        schedule: DeformationSchedule | None = None,
        motion: MotionSettings | None = None,
        loss: Mapping[str, float] = DEFORMATION_LOSS,
        iterations_per_step: int = 10,
        graphs: Graphs = "auto",
        decoder_precision: Precision = "auto",
    ) -> None:
        """Build the stage; the defaults are the paper's for inward-facing scenes.

        Args:
            rest: what the canonical stage learned (``CanonicalStage.result()`` or
                ``load_checkpoint``); its fields are frozen.
            schedule: resolutions, iterations and frames.
            motion: learning rate and how batches are drawn.
            loss: weights of the loss terms; ``tv`` is the total variation of both fields.
            iterations_per_step: optimiser iterations in one Lightning step.
            graphs: whether a GPU replays iterations from CUDA graphs: ``auto`` where it can.
            decoder_precision: what the colour network computes in; ``auto``: ``bfloat16`` on a
                GPU that multiplies it.
        """
        super().__init__(iterations_per_step, graphs, decoder_precision)
        self.schedule = schedule or DeformationSchedule()
        self.motion = motion or MotionSettings()
        weights = dict(loss)
        self.tv = weights.pop("tv", 0.0)
        self.losses = WeightedLoss(MOTION_TERMS, weights)
        canonical, occupancy = rest.model.canonical, rest.model.occupancy
        model = SceneModel(canonical, occupancy, rest.model.settings, space=rest.model.space)
        self.scene_model = model.requires_grad_(False)
        self.architecture = rest.metadata.architecture
        self.records = rest.metadata.records
        placeholder = torch.zeros(2, 2, 2, 3, requires_grad=True)
        self._optimizer = GridAdam(
            [{"params": [placeholder], "lr": self.motion.learning_rate, "name": "motion"}]
        )
        self.visits: list[ActiveFrame] = []
        self._losses: list[list[float]] = []
        self._previous: Tensor | None = None
        self.register_state_dict_pre_hook(  # type: ignore[no-untyped-call]
            lambda *_: self.write_back()
        )
        self.register_load_state_dict_post_hook(  # type: ignore[no-untyped-call]
            lambda *_: self.check_out()
        )

    @property
    def memory_keys(self) -> tuple[str, ...]:
        """Grid sizes and rays; how many frames are visited together, if there are several."""
        keys = ("schedule.deformation.sides", "schedule.deformation.rays")
        return (*keys, "schedule.deformation.parallel_frames") if len(self.visits) > 1 else keys

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Present shape of the motion grids."""
        return self.field.shape

    @property
    def model(self) -> SceneModel:
        """The moving scene learned so far, the present visits included."""
        self.write_back()
        return self.scene_model

    @property
    def model_now(self) -> SceneModel:
        """The moving scene; what the present visits have learned may not be in it yet."""
        return self.scene_model

    @property
    def field(self) -> DeformationField:
        """The deformation field."""
        assert self.scene_model.deformation is not None, "the stage has not been set up"
        return self.scene_model.deformation

    @property
    def optimizer(self) -> GridAdam:
        """Adam over the two slices of each visited frame."""
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
            self.field.rest(on_host=self._rests_on_host(), half=self.motion.store_half)
        scale = self.scene_model.canonical.box.longest if self.motion.unit == "box" else 1.0
        self._optimizer.param_groups[0]["base_lr"] = self.motion.learning_rate * scale

    def _rests_on_host(self) -> bool:
        """Whether the displacements of all frames are kept on the host."""
        device = self.trainer.strategy.root_device
        if self.trainer.world_size > 1 or self.motion.store == "device":
            return False  # processes talk device to device
        if self.motion.store == "host":
            return True
        if device.type != "cuda":
            return False
        free, _ = torch.cuda.mem_get_info(device)
        frames = len(self.field.clock)
        fits = fits_on_device(
            free,
            frames,
            self.field.box.grid_shape(self.schedule.sides[-1] ** 3),
            half=self.motion.store_half,
            parallel=self.schedule.beside(-1, frames),
        )
        if not fits:
            log.info("motion: %.1f GB are free on the GPU; the frames rest on the host", free / 1e9)
        return not fits

    def enter(self, phase: Phase) -> None:
        """Go to the phase's frames: grow the grids if a level begins, fresh Adam."""
        assert isinstance(phase, DeformationPhase)
        previous, self.phase = self.phase, phase
        assert previous is None or isinstance(previous, DeformationPhase)
        self._losses = [[] for _ in phase.frames]
        self.write_back()
        if previous is not None and previous.level != phase.level:
            self._open_visits(0)
            self.field.resize(phase.side**3)
        views = self._device_views()
        if self._previous is None:
            self._previous = previous_images(views)
        if phase.carries:
            for frame in phase.frames:
                self.field.carry(frame)
        if self._along_flow(phase, views):
            for frame in phase.frames:
                self._follow_flow(views, frame)
        if len(self.visits) == len(phase.frames):
            self._optimizer.forget(0)
        else:
            self._open_visits(len(phase.frames))
        for visit, frame in zip(self.visits, phase.frames, strict=True):
            visit.enter(self.field, frame)
        following = self.schedule.phase(phase.stop, len(self.field.clock))
        made_anew = following.carries or self._along_flow(following, views)
        if following.level == phase.level and following != phase and not made_anew:
            self.field.expect(following.frames)
        self.update_occupancy()
        for visit in self.visits:
            visit.pools = self._frame_pools(views, visit)

    def _along_flow(self, phase: DeformationPhase, views: Views) -> bool:
        """Whether the phase's frames are moved from where the frames before them have been seen."""
        asked = self.motion.start == "flow" and views.flow is not None
        return asked and phase.level == 0 and phase.follows

    def _open_visits(self, count: int) -> None:
        """Make room for so many visits at the field's present resolution."""
        # What belonged to those before is gone before theirs is made.
        self.loop.let_go()
        self.visits = []
        self._optimizer.replace(0, [])
        self.visits = [ActiveFrame.of(self.field, self.scene_model.occupancy) for _ in range(count)]
        slices = [visit.slices for visit in self.visits]
        smoothing = total_variation_weight(self.tv, max(self.field.shape), self.schedule.rays)
        self._optimizer.replace(
            0, [tensor for pair in slices for tensor in pair], smoothing=smoothing
        )
        self.renew(self.schedule.rays, slices)

    def write_back(self) -> None:
        """Put what the present visits have learned into the field."""
        for visit in self.visits:
            visit.leave(self.field)
        if self.visits:
            self.field.settle()

    def check_out(self) -> None:
        """Take the visited frames out of a field that has been loaded again."""
        for visit in self.visits:
            if visit.frame:
                visit.enter(self.field, visit.frame)

    def on_train_end(self) -> None:
        """End the last visits."""
        self.write_back()
        self.visits = []

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
        broadcast([self.field.to_canonical[frame], self.field.to_time[frame]])

    def _device_views(self) -> Views:
        views: Views = self.trainer.datamodule.training_views(  # type: ignore[attr-defined]
            self.capture, self.device
        )
        return views

    def update_occupancy(self) -> None:
        """Find where each visited frame's matter is under the present field."""
        for visit in self.visits:
            visit.occupancy.refill(deformed_occupancy(self.scene_model, visit.warp))

    @torch.no_grad()
    def _frame_pools(self, views: Views, visit: ActiveFrame) -> list[PixelPool]:
        """The pixels to learn a frame from: a pool a batch can be drawn from, by turns."""
        images = self._images(views, visit.frame)
        if len(images) == 0:
            raise DevrfError(f"dynamic training set: no image at frame {visit.frame}")
        if self.motion.pixels == "occupied":
            pools = [self._useful(views, image, visit.occupancy) for image in images]
        else:
            pools = [all_pixels(views, image[None]) for image in images]
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

    def _useful(self, views: Views, image: Tensor, matter: Occupancy) -> PixelPool:
        """Pixels on the matte, or whose rays meet the frame's matter; all if there are none."""
        wanted = rays_hit_occupied(views.cameras, int(image), self.scene_model, matter)
        if views.has_alpha:
            wanted |= views.pixels[image, :, :, 3].flatten() > 0
        pool = wanted_pixels(views, image[None], wanted[None])
        return pool if len(pool) else all_pixels(views, image[None])

    def prepare(self) -> None:
        """Look up the frames' occupancy anew, when it is time."""
        assert isinstance(self.phase, DeformationPhase)
        since = self.iteration - self.phase.start
        if since and since % self.motion.occupancy_every == 0:
            with span("sampling"):
                self.update_occupancy()

    def draw(self, lane: ParallelBatch) -> Pixels:
        """Random pixels of the lane's frame, of its views by turns or of all."""
        with span("batch"):
            pools = self.visits[lane.number].pools
            pool = pools[self.iteration % len(pools)]
            image, flat = pool.draw(share(self.schedule.rays), self.generator)
            background = background_color(self.scene.background, len(image), self.generator)
            return Pixels(image, flat, background)

    def loss(
        self, lane: ParallelBatch, views: Views, pixels: Pixels
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Render a batch of the lane's frame through its warp; compare images and motion."""
        assert self._previous is not None
        visit, space = self.visits[lane.number], self.scene_model.space
        with span("batch"):
            batch = gather_batch(views, pixels.image, pixels.flat, pixels.background, space)
        output = self.see(batch.rays, visit.occupancy, batch.background, lane.room, visit.warp)
        before = visit.unwarp_previous(looked_up=lane.room is not None)
        prediction = MotionPrediction(
            output, batch, visit.unwarp, before, views.cameras, self._previous, space
        )
        with span("losses"):
            total, terms = self.losses(prediction)
            return total, {**terms, **visibility(prediction)}

    def rollback(self, iteration: int, lr_scale: float) -> None:
        """Go on from an earlier iteration of the present visits; look anew where matter is."""
        super().rollback(iteration, lr_scale)
        self._losses = [[] for _ in self.visits]
        self.update_occupancy()

    def settled(self, losses: Tensor) -> bool:
        """Whether each visited frame's loss has stopped falling, if anybody wants to know."""
        gain = self.motion.min_rel_improvement
        if gain is None:
            return False
        for seen, loss in zip(self._losses, losses.tolist(), strict=True):
            seen.append(loss)
        return all(settled(seen, gain) for seen in self._losses)

    def phase_state(self) -> dict[str, Any]:
        """What the visits have at hand, and how their losses fell."""
        return {
            "visits": [self._visit_at_hand(visit) for visit in self.visits],
            "losses": [list(seen) for seen in self._losses],
        }

    def _visit_at_hand(self, visit: ActiveFrame) -> dict[str, Any]:
        """Where the visited frame's matter was last seen, and the pixels to learn from.

        And the frame itself, where the field would not keep it exactly.
        """
        views, mask = self._device_views(), visit.occupancy.mask
        images, area = self._images(views, visit.frame), views.height * views.width
        exact = visit.slices if self.motion.store_half else ()
        return {
            "occupancy": pack_bits(mask),
            "shape": list(mask.shape),
            "pixels": [pack_bits(pool.mask(images, area)) for pool in visit.pools],
            "displacements": [tensor.detach().cpu() for tensor in exact],
        }

    def restore_phase(self, phase: Phase, kept: dict[str, Any]) -> None:
        """Go on with the visits of ``phase``, the field being loaded."""
        assert isinstance(phase, DeformationPhase)
        self._previous = previous_images(self._device_views())
        self._open_visits(len(phase.frames))
        self._losses = [list(seen) for seen in kept["losses"]]
        for visit, frame, one in zip(self.visits, phase.frames, kept["visits"], strict=True):
            visit.enter(self.field, frame)
            self._take_up_visit(visit, one)

    @torch.no_grad()
    def _take_up_visit(self, visit: ActiveFrame, kept: dict[str, Any]) -> None:
        views = self._device_views()
        images, area = self._images(views, visit.frame), views.height * views.width
        for tensor, exact in zip(visit.slices, kept["displacements"], strict=False):
            tensor.copy_(exact)
        mask = unpack_bits(kept["occupancy"], kept["shape"], self.device)
        visit.occupancy.refill(Occupancy(mask, self.scene_model.canonical.box))
        visit.pools = [
            PixelPool.of_mask(images, unpack_bits(bits, (len(images), area), self.device))
            for bits in kept["pixels"]
        ]

    def metadata(self) -> CheckpointMetadata:
        """What the checkpoint is, and how to build its model."""
        return CheckpointMetadata(
            scene=self.scene.name,
            fingerprint=self.scene.fingerprint,
            architecture=self.architecture,
            settings=self.scene_model.settings,
            space=self.scene_model.space,
            records={**self.records, "deformation": self.record},
            training_config=self.training_config,
            complete=self.iteration >= self.total_iterations,
        )
