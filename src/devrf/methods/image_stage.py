"""Trains a method on images, one an iteration, as a stage of a protocol says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.batch import FrameSortedPixels, ImageBatch, gather_image
from devrf.engine.protocol import ProtocolStage
from devrf.errors import expect
from devrf.methods.base import ImageTrainable
from devrf.methods.ray_plan import REHEARSED_ITERATIONS, RayPlan
from devrf.methods.ray_schedule import RaySchedule
from devrf.methods.ray_stage import RayStage
from devrf.scenes.scene import Views

# What happens in the course of a stage.
WHOLE = "images of whole size"
MOVING = "moving images shown"
# Pixels of a side that half an image has at least: from 25 little is learned, as slowly as from 50.
LEAST_SIDE = 32


class ImagePlan(RayPlan):
    """The plan of an :class:`ImageStage`."""

    def check(self) -> None:
        """Refuse a protocol that the method cannot learn by, and what only rays have."""
        super().check()
        schedule: RaySchedule = self.settings["schedule"]
        for key, usual in (("centre_crop", 0), ("times_per_batch", None)):
            value = getattr(schedule, key)
            expected = f"{usual}, as the method learns from whole images"
            expect(value == usual, f"{schedule.key}.{key}", expected, value)

    def rehearsed(self) -> ImagePlan:
        """Fewer iterations of a smaller method."""
        schedule: RaySchedule = self.settings["schedule"]
        factor = min(1.0, REHEARSED_ITERATIONS / schedule.iterations)
        model = self.model.rehearsed(factor)
        return self.with_settings(schedule=schedule.scaled(factor), model=model)


class ImageStage(RayStage):
    """Learns a method from a random one of its images an iteration.

    A batch's rays are the image's pixels; of an image that has more, some rows are drawn. Of a
    stage that learns from both captures a fixed share of the images is static, whatever their
    numbers.
    """

    plan = ImagePlan
    useful_share = 1.0
    scene_model: ImageTrainable

    def __init__(
        self,
        model: ImageTrainable,
        schedule: RaySchedule,
        loss: Mapping[str, float],
        protocol_stage: ProtocolStage,
        static_share: float = 0.5,
        earlier: LoadedCheckpoint | None = None,
        half_size: float = 0.0,
        moving_share: float | None = None,
        static_first: float = 0.0,
    ) -> None:
        """Build the stage.

        Args:
            model: as of :class:`~devrf.methods.ray_stage.RayStage`, as are the next five.
            schedule: iterations, pixels and rates.
            loss: weights of the method's loss terms.
            protocol_stage: which data trains which parts.
            static_share: share of static images in a stage of both captures.
            earlier: the result of an earlier stage, to go on with.
            half_size: share of the stage in which images have half of their width and height, if
                at least ``LEAST_SIDE`` pixels of each are left.
            moving_share: share of moving images in a stage of both captures; None: as
                ``static_share`` says.
            static_first: share of such a stage in which all images are static.
        """
        shares = {"half_size": half_size, "moving_share": moving_share}
        for name, share in {**shares, "static_first": static_first}.items():
            expect(share is None or 0 <= share < 1, f"ray_stage.{name}", "in [0, 1)", share)
        self.half_size, self.static_first = half_size, static_first
        static = static_share if moving_share is None else 1 - moving_share
        super().__init__(model, schedule, loss, protocol_stage, static, earlier)

    def pool_of(self, views: Views) -> FrameSortedPixels:
        """A pixel for each image."""
        return FrameSortedPixels.of_images(views)

    def _with_method(self) -> RaySchedule:
        schedule = super()._with_method()
        changes = {WHOLE: self.half_size}
        if self.capture == "both":
            changes[MOVING] = self.static_first
        at = {name: round(share * schedule.total) for name, share in changes.items() if share}
        return replace(schedule, milestones={**schedule.milestones, **at})

    def draw_batch(self, views: Views | tuple[Views, ...]) -> ImageBatch:
        """A random image, or some of its rows."""
        sets = views if isinstance(views, tuple) else (views,)
        draw: Any = {"generator": self.generator, "device": self.generator.device}
        iteration, milestones = self.position.iteration, self.schedule.milestones
        number = 0
        if len(sets) > 1 and iteration >= milestones.get(MOVING, 0):
            number = int(torch.rand((), **draw) > self.static_share)
        drawn, pool = sets[number], self.pools[number]
        chosen, _ = pool.draw(1, self.shown_frames(pool), self.generator)
        background = self.background(chosen, self.generator).view(-1, 3)[0]
        image = int(chosen)
        width, height = drawn.cameras.size_of(image)
        halved = iteration < milestones.get(WHOLE, 0) and min(width, height) >= 2 * LEAST_SIDE
        shrink = 2 if halved else 1
        rows = min(max(self.batch_size.rays(self._rays) // width, shrink), height)
        first = 0
        if rows < height:
            first = int(torch.randint(height - rows + 1, (), **draw))
        batch = gather_image(drawn, image, background, (first, first + rows), shrink)
        return replace(batch, image=image + sum(map(len, sets[:number])))
