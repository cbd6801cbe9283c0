"""The plan of a stage that learns a method from rays, before it is built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from warp import Kernel

from devrf.engine.needs import LEARNED, SIZE, StageNeeds, tensor_bytes
from devrf.engine.plan import StagePlan
from devrf.engine.protocol import ProtocolStage
from devrf.methods.base import Trainable
from devrf.methods.ray_schedule import RaySchedule
from devrf.scenes.scene import Scene

# A rehearsal has at most so many iterations, rays and times of a batch; at least this rate.
REHEARSED_ITERATIONS = 800
REHEARSED_RAYS = 256
REHEARSED_TIMES = 2
REHEARSED_RATE = 2e-3
REHEARSED_CROP = 0.25


class RayPlan(StagePlan):
    """The plan of a :class:`~devrf.methods.ray_stage.RayStage`, or of one of images."""

    def build(self, **earlier: Any) -> Any:
        """The stage, told which data trains which parts of the method."""
        share = self.protocol.static_share
        return super().build(protocol_stage=self.protocol_stage, static_share=share, **earlier)

    @property
    def protocol_stage(self) -> ProtocolStage:
        """The stage as its protocol has it."""
        return self.protocol[self.name]

    def check(self) -> None:
        """Refuse a protocol that the method cannot learn by."""
        self.model.check_protocol(self.protocol.name)

    @property
    def model(self) -> Trainable[Any]:
        """The method, not set up."""
        model: Trainable[Any] = self.settings["model"]
        return model

    @property
    def kernels(self) -> Sequence[Kernel]:
        """The method's."""
        return self.model.kernels

    def iterations(self, scene: Scene) -> int:
        """The stage's share of the schedule."""
        schedule: RaySchedule = self.settings["schedule"]
        return self.protocol_stage.share_of(schedule.iterations)

    def needs(self, scene: Scene, earlier: StagePlan | None) -> StageNeeds:
        """Images, the whole of the model, and a batch."""
        schedule: RaySchedule = self.settings["schedule"]
        rays = max(schedule.rays, schedule.rays_without_hull or 0)
        learned = self.model.most_bytes
        width = "ray_stage.model.settings.width"
        parts = {
            SIZE: float(tensor_bytes(scene.captures.values())),
            width: LEARNED * learned,
            # Three values are kept for each output of each layer, for 128 samples of a ray.
            "ray_stage.schedule.rays": rays * 128 * 12 * self.model.sample_outputs,
        }
        return StageNeeds(parts, {width: learned})

    def rehearsed(self) -> RayPlan:
        """Small networks and batches; rates at which networks learn in hundreds of iterations."""
        schedule: RaySchedule = self.settings["schedule"]
        factor = min(1.0, REHEARSED_ITERATIONS / schedule.iterations)
        usual = schedule.learning_rate
        rate = min(max(usual, REHEARSED_RATE), 10 * usual)
        times = schedule.times_per_batch
        scaled = schedule.scaled(factor)
        # Few iterations may end in the background's colour unless they begin with the foreground.
        centre_crop = max(scaled.centre_crop, round(REHEARSED_CROP * scaled.iterations))
        smaller = replace(
            scaled,
            # Where a batch has few times, its rays are not what takes time.
            rays=min(schedule.rays, REHEARSED_RAYS * (1 if times is None else 16)),
            rays_without_hull=None,
            learning_rate=rate,
            learning_rate_without_hull=None,
            centre_crop=centre_crop,
            final_learning_rate=schedule.final_learning_rate * rate / usual,
            times_per_batch=None if times is None else min(times, REHEARSED_TIMES),
        )
        return self.with_settings(schedule=smaller, model=self.model.rehearsed(factor))
