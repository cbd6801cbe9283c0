"""Trains any method on rays, as a stage of a protocol says."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.batch import (
    BackgroundColor,
    FrameSortedPixels,
    ImageBatch,
    RayBatch,
    concatenated,
)
from devrf.engine.grid_adam import GridAdam
from devrf.engine.protocol import ProtocolStage
from devrf.engine.schedule import Phase, unscaled
from devrf.engine.stage import Stage, Terms
from devrf.methods.base import Trainable
from devrf.methods.batch import gather_batch
from devrf.methods.ray_plan import RayPlan
from devrf.methods.ray_schedule import GROWN, RaySchedule
from devrf.methods.weighted_loss import counted_weights, visibility, weighted_sum
from devrf.scenes.scene import Views
from devrf.scenes.space import dynamic_only
from devrf.system.profiling import span


class RayStage(Stage):
    """Learns a method from random rays of all its images.

    A batch's rays have times of their own. Of a stage that learns from both captures a fixed share
    of each batch is static, whatever the numbers of images.
    """

    rate_keys = "ray_stage.schedule.learning_rate or the weights of ray_stage.loss"
    plan = RayPlan
    scene_model: Trainable[Any]
    schedule: RaySchedule

    def __init__(
        self,
        model: Trainable[Any],
        schedule: RaySchedule,
        loss: Mapping[str, float],
        protocol_stage: ProtocolStage,
        static_share: float = 0.5,
        earlier: LoadedCheckpoint | None = None,
    ) -> None:
        """Build the stage.

        Args:
            model: the method; not used where the stage builds on ``earlier``.
            schedule: iterations, rays and rates.
            loss: weights of the method's loss terms; a term of weight 0 is not computed.
            protocol_stage: which data trains which parts.
            static_share: share of static rays in a batch of both captures.
            earlier: the result of an earlier stage, to go on with.
        """
        super().__init__(schedule.iterations_per_step)
        self.batch_size.keys = ("ray_stage.schedule.rays",)
        self.name = protocol_stage.name
        self.capture = protocol_stage.capture
        self.protocol_stage = protocol_stage
        total = protocol_stage.share_of(schedule.iterations)
        self.schedule = replace(schedule, iterations=total)
        self.static_share = static_share
        self.scene_model = model
        self._ready = earlier is not None
        if earlier is not None:
            self.scene_model = earlier.model.train()
            self.provenance.earlier_records = earlier.metadata.records
        self.keeps_batches = self.scene_model.keeps_batches
        if schedule.times_per_batch is not None:
            self.useful_share = 1 / schedule.times_per_batch
        self.weights = counted_weights(loss, self.scene_model.losses, "ray_stage.loss")
        self.pools: list[FrameSortedPixels] = []
        self._centres: list[FrameSortedPixels] = []
        self._rays = schedule.rays

    def iterate(self, views: Views | tuple[Views, ...]) -> Terms:
        """Learn the method from one batch."""
        with span("batch"):
            batch = self.draw_batch(views)
        output = self.scene_model(batch)
        with span("losses"):
            values = self.scene_model.loss_terms(output, batch, self.weights)
            loss, terms = weighted_sum(values, self.weights)
            terms |= visibility(output.transmittance, batch.alpha)
            if "render" not in terms:  # what the curves' PSNR is of
                valid = batch.valid if isinstance(batch, ImageBatch) else None
                missed = (output.color.detach() - batch.color).square().mean(dim=1)
                counted = torch.ones_like(missed) if valid is None else valid.to(missed)
                terms["render"] = (missed * counted).sum() / counted.sum().clamp(min=1)
        self.optimise(loss)
        return {"loss": loss.detach(), **terms}

    def draw_batch(self, views: Views | tuple[Views, ...]) -> RayBatch | ImageBatch:
        """A batch of the training views."""
        image, flat = self.draw()
        background = self.background(image, self.generator)
        return self._gather(views, image, flat, background)

    def draw(self) -> tuple[Tensor, Tensor]:
        """Random pixels: their images (R,), numbered through, and places there (R,), int64.

        Those of static images come first, where both captures are learned from; last are those
        the model asks for.
        """
        rays = self.batch_size.rays(self._rays)
        cropped = self.position.iteration < self.schedule.centre_crop
        pools = self._centres if cropped else self.pools
        static = round(rays * self.static_share)
        counts = [static, rays - static] if len(pools) > 1 else [rays]
        images: list[Tensor] = []
        flats: list[Tensor] = []
        offset = 0
        # Fewer times in a part of the schedule's batch.
        times = self.schedule.times_per_batch
        times_left = None if times is None else max(1, round(times * self.batch_size.share))
        for pool, count in zip(pools, counts, strict=True):
            frames = self.shown_frames(pool)
            image, flat = pool.draw(count, frames, self.generator, times=times_left)
            images.append(image + offset)
            flats.append(flat)
            offset += pool.images
            times_left = None if times_left is None else max(1, times_left - pool.frames)
        extra = self.scene_model.extra_pixels(self.generator, self.batch_size.of_process)
        if extra is not None:
            image, flat = extra
            images.append(image)
            flats.append(flat)
        return torch.cat(images), torch.cat(flats)

    def setup(self, stage: str) -> None:
        """Give the model what it needs of the scene, and make the optimiser."""
        # Before the clock starts: priors are read, or made as a scene's reader makes them.
        datamodule = getattr(self.trainer, "datamodule", None)
        if datamodule is not None and datamodule.priors == "all":
            datamodule.provide(self.scene_model.priors)
        super().setup(stage)
        if stage == "fit":  # pixels are gathered anew, and the colours behind them chosen
            self.phase = None
            self.pools = []
        if not self._ready:
            # A protocol without a stage that learns from the static set does not look at it.
            alone = self.capture == "dynamic" and self.protocol_stage.builds_on is None
            self.scene_model.setup(dynamic_only(self.scene) if alone else self.scene)
            self._ready = True
        if hasattr(self, "optimizer"):
            return
        self.scene_model.begin_stage(self.protocol_stage)
        self.schedule = schedule = self._with_method()
        highest = schedule.learning_rate
        if not self.scene_model.has_hull:
            highest = schedule.learning_rate_without_hull or highest
        groups = self.scene_model.param_groups()
        for group in groups:
            rate = highest * group.pop("rate", 1.0)
            group.update(lr=rate, base_lr=rate)
        first, second = schedule.betas
        self.optimizer = GridAdam(groups, betas=(first, second), eps=schedule.eps)

    def _with_method(self) -> RaySchedule:
        """The schedule with what the method itself does in the course of the stage."""
        schedule, total = self.schedule, self.schedule.total
        milestones = dict(self.scene_model.milestones(total))
        if schedule.curriculum:
            milestones["all frames shown"] = math.ceil(schedule.curriculum * total)
        if schedule.centre_crop:
            milestones["whole images shown"] = schedule.centre_crop
        if schedule.warmup:
            milestones["rate grown"] = math.ceil(schedule.warmup * total)
        growths = sorted({*self.scene_model.growths(total)})
        return replace(schedule, growths=growths, milestones=milestones)

    def enter(self, phase: Phase) -> None:
        """Let grids grow; when the stage begins or goes on, gather the pixels to draw from."""
        self.events[GROWN] += self.phase not in (None, phase)  # of a resumed run not again
        self.phase = phase
        grown = sum(iteration <= phase.start for iteration in self.schedule.growths)
        sources = self.scene_model.grow(grown) or {}
        for index, group in enumerate(self.scene_model.param_groups()):
            present = self.optimizer.param_groups[index]["params"]
            parameters = group.pop("params")
            group.pop("rate", None)
            if any(new is not old for new, old in zip(parameters, present, strict=True)):
                self.optimizer.replace(index, parameters, sources.get(group["name"]), **group)
        if self.pools:
            return
        fewer = self.schedule.rays_without_hull
        if fewer is not None and not self.scene_model.has_hull:
            self._rays = fewer
        views = [self.datamodule.training_views(name, self.device) for name in self.images]
        if self.scene_model.random_background and all(view_set.has_alpha for view_set in views):
            self.background = BackgroundColor("random")
        self.pools = [self.pool_of(view_set) for view_set in views]
        if self.schedule.centre_crop:
            self._centres = [FrameSortedPixels.of(view_set, centre=True) for view_set in views]
        self.scene_model.prepare_priors(views, self.weights)

    def pool_of(self, views: Views) -> FrameSortedPixels:
        """The pixels that batches are drawn from."""
        return FrameSortedPixels.of(views)

    def prepare(self) -> None:
        """Let the model follow the schedule, whose configured iterations it knows."""
        total = self.schedule.total
        whole = unscaled(self).total
        iteration = self.position.iteration
        self.scene_model.on_iteration(iteration * whole // total, whole)
        for name, at in self.schedule.milestones.items():
            self.events[name] = int(iteration >= at)

    def shown_frames(self, pool: FrameSortedPixels) -> int:
        """Number of frames that the curriculum shows by now."""
        share = self.schedule.curriculum * self.schedule.total
        iteration = self.position.iteration
        if iteration >= share:
            return pool.frames
        return min(pool.frames, max(3, int(pool.frames * iteration / share)))

    def _gather(
        self,
        views: Views | tuple[Views, ...],
        image: Tensor,
        flat: Tensor,
        background: Tensor,
    ) -> RayBatch:
        """The batch of pixels, in the order of their images' captures."""
        batches: list[RayBatch] = []
        offset = 0
        for view_set in views if isinstance(views, tuple) else (views,):
            in_capture = (image >= offset) & (image < offset + len(view_set))
            index = in_capture.nonzero()[:, 0]
            batch = gather_batch(
                view_set,
                image=image[index] - offset,
                flat=flat[index],
                background=background if background.dim() == 1 else background[index],
                space=self.scene_model.space,
            )
            batches.append(replace(batch, image=image[index]))
            offset += len(view_set)
        return batches[0] if len(batches) == 1 else concatenated(batches)
