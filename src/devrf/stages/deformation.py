"""The deformation stage: dynamic views + the canonical field → how the scene moves."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from devrf.data.batch import Pixels, background_color, gather_batch
from devrf.data.correspondence import previous_images
from devrf.data.pool import PixelPool, all_pixels
from devrf.errors import DevrfError
from devrf.fields.bits import pack_bits, unpack_bits
from devrf.fields.deformation import DeformationField
from devrf.fields.occupancy import Occupancy
from devrf.losses.composer import WeightedLoss
from devrf.losses.motion import MOTION_TERMS, MotionPrediction, total_variation_weight
from devrf.losses.photometric import visibility
from devrf.ops.adam import GridAdam
from devrf.ops.spans import span
from devrf.rendering.model import SceneModel, deformed_occupancy
from devrf.scenes.scene import CaptureName, Views
from devrf.stages.checkpoint import Passport, Stored
from devrf.stages.flow_start import follow, start_from_tracks
from devrf.stages.memory import StageMemory, motion_memory
from devrf.stages.ranks import share, take_from_first
from devrf.stages.replay import Graphs
from devrf.stages.schedules import DeformationPhase, DeformationSchedule
from devrf.stages.settings import DEFORMATION_LOSS, MotionSettings, Precision
from devrf.stages.settling import settled
from devrf.stages.stage import Phase, ScheduledStage
from devrf.stages.useful import meets_matter
from devrf.stages.visit import Visit

log = logging.getLogger(__name__)


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
            decoder_precision: what the colour network computes in; ``auto``: ``bfloat16`` where
                the device multiplies it.
        """
        super().__init__(iterations_per_step, graphs, decoder_precision)
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
        self._losses: list[float] = []
        self._previous: Tensor | None = None
        self.register_state_dict_pre_hook(  # type: ignore[no-untyped-call]
            lambda *_: self._put_back()
        )
        self.register_load_state_dict_post_hook(  # type: ignore[no-untyped-call]
            lambda *_: self._take_out()
        )

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Present shape of the motion grids."""
        return self.field.shape

    @property
    def model(self) -> SceneModel:
        """The moving scene learned so far, the present visit included."""
        self._put_back()
        return self.scene_model

    @property
    def model_now(self) -> SceneModel:
        """The moving scene; what the present visit has learned may not be in it yet."""
        return self.scene_model

    @property
    def field(self) -> DeformationField:
        """The deformation field."""
        assert self.scene_model.deformation is not None, "the stage has not been set up"
        return self.scene_model.deformation

    def _memory(self, on_host: bool) -> StageMemory:
        model = self.scene_model
        return motion_memory(
            self.scene, model.canonical, self.schedule, model.settings.step, on_host=on_host,
            half=self.motion.store_half,
        )

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
        too_much = self._memory(on_host=False).peak > free
        if too_much:
            log.info("motion: %.1f GB are free on the GPU; the frames rest on the host", free / 1e9)
        return too_much

    def enter(self, phase: Phase) -> None:
        """Go to the phase's frame: grow the grids if a level begins, fresh Adam."""
        assert isinstance(phase, DeformationPhase)
        previous, self.phase = self.phase, phase
        assert previous is None or isinstance(previous, DeformationPhase)
        self._losses = []
        self._put_back()
        if previous is not None and previous.level != phase.level:
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
        if self._visit is None:
            self._begin_level()
        else:
            self._optimizer.forget(0)
        self.visit.enter(self.field, phase.frame)
        following = self.schedule.phase(phase.stop, len(self.field.clock))
        if following.level == phase.level and not following.carries:
            self.field.expect(following.frame)
        self._look_around()
        self.visit.pools = self._frame_pools(views, phase.frame)

    def _begin_level(self) -> None:
        """Make room for visits at the field's present resolution."""
        self._visit = Visit.of(self.field, self.scene_model.occupancy)
        smoothing = total_variation_weight(self.tv, max(self.field.shape), self.schedule.rays)
        self._optimizer.replace(0, self._visit.slices, smoothing=smoothing)
        self.renew(self.schedule.rays)

    def _put_back(self) -> None:
        """Put what the present visit has learned into the field."""
        if self._visit is not None:
            self._visit.leave(self.field)
            self.field.settle()

    def _take_out(self) -> None:
        """Take the visited frame out of a field that has been loaded again."""
        if self._visit is not None and self._visit.frame:
            self._visit.enter(self.field, self._visit.frame)

    def on_train_end(self) -> None:
        """End the last visit."""
        self._put_back()
        self._visit = None

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

    def _look_around(self) -> None:
        """Find where the visited frame's matter is under the present field."""
        self.visit.occupancy.refill(deformed_occupancy(self.scene_model, self.visit.warp))

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
        if views.counted is not None:
            kept = kept[views.counted[image].flatten()]
        return PixelPool(pool.image[kept], pool.flat[kept]) if bool(kept.any()) else pool

    def prepare(self) -> None:
        """Look up the frame's occupancy anew, when it is time."""
        assert isinstance(self.phase, DeformationPhase)
        since = self.iteration - self.phase.start
        if since and since % self.motion.occupancy_every == 0:
            with span("sampling"):
                self._look_around()

    def draw(self) -> Pixels:
        """Random pixels of the visited frame, of its views by turns or of all."""
        with span("batch"):
            pool = self.visit.pools[self.iteration % len(self.visit.pools)]
            image, flat = pool.draw(share(self.schedule.rays), self.generator)
            background = background_color(self.scene.background, len(image), self.generator)
            return Pixels(image, flat, background)

    def loss(self, views: Views, pixels: Pixels) -> tuple[Tensor, dict[str, Tensor]]:
        """Render a batch of the visited frame through its warp; compare images and motion."""
        assert self._previous is not None
        visit, space = self.visit, self.scene_model.space
        with span("batch"):
            batch = gather_batch(views, pixels.image, pixels.flat, pixels.background, space)
        output = self.see(batch.rays, visit.occupancy, batch.background, visit.warp)
        before = visit.unwarp_previous(looked_up=self.room is not None)
        prediction = MotionPrediction(
            output, batch, visit.unwarp, before, views.cameras, self._previous, space
        )
        with span("losses"):
            total, terms = self.losses(prediction)
            return total, {**terms, **visibility(prediction)}

    def go_back(self, iteration: int, caution: float) -> None:
        """Go on from an earlier iteration of the present visit; look anew where matter is."""
        super().go_back(iteration, caution)
        self._losses = []
        self._look_around()

    def settled(self, means: Mapping[str, Tensor]) -> bool:
        """Whether the visited frame's loss has stopped falling, if anybody wants to know."""
        gain = self.motion.least_gain
        if gain is None:
            return False
        self._losses.append(float(means["loss"]))
        return settled(self._losses, gain)

    def at_hand(self) -> dict[str, Any]:
        """Where the visited frame's matter was last seen, and the pixels to learn from.

        And the frame itself, where the field would not keep it exactly.
        """
        assert isinstance(self.phase, DeformationPhase)
        views, mask = self._device_views(), self.visit.occupancy.mask
        images, area = self._images(views, self.phase.frame), views.height * views.width
        exact = self.visit.slices if self.motion.store_half else ()
        return {
            "occupancy": pack_bits(mask),
            "shape": list(mask.shape),
            "pixels": [pack_bits(pool.mask(images, area)) for pool in self.visit.pools],
            "displacements": [tensor.detach().cpu() for tensor in exact],
            "losses": list(self._losses),
        }

    @torch.no_grad()
    def take_up(self, phase: Phase, kept: dict[str, Any]) -> None:
        """Go on with the visit of ``phase``, the field being loaded."""
        assert isinstance(phase, DeformationPhase)
        views = self._device_views()
        self._previous = previous_images(views)
        images, area = self._images(views, phase.frame), views.height * views.width
        self._begin_level()
        self._losses = list(kept["losses"])
        self.visit.enter(self.field, phase.frame)
        for tensor, exact in zip(self.visit.slices, kept["displacements"], strict=False):
            tensor.copy_(exact)
        mask = unpack_bits(kept["occupancy"], kept["shape"], self.device)
        self.visit.occupancy.refill(Occupancy(mask, self.scene_model.canonical.box))
        self.visit.pools = [
            PixelPool.of_mask(images, unpack_bits(bits, (len(images), area), self.device))
            for bits in kept["pixels"]
        ]

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
