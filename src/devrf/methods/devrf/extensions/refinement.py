"""The refinement stage: the canonical field learns on from both captures, through the warps.

See docs/method.md#refinement. It is a stage of a protocol that builds on ``deformation``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.batch import PixelPool, Pixels
from devrf.engine.batches import frame_pools, static_pool
from devrf.engine.learner import ParallelBatch, Phase
from devrf.errors import expect
from devrf.methods.devrf.losses import PHOTOMETRIC_TERMS, Prediction, batch_loss
from devrf.methods.devrf.settings import FINE_LOSS, CanonicalRates, Precision
from devrf.methods.devrf.voxel_stage import VoxelStage, field_optimizer
from devrf.methods.weighted_loss import counted_weights
from devrf.rendering.occupancy import Occupancy, dilate
from devrf.scenes.scene import Views
from devrf.system.profiling import span


@dataclass(frozen=True)
class RefinementSchedule:
    """How the canonical field learns from both captures.

    Attributes:
        iterations: of the stage; 0: a protocol leaves it out.
        rays: of a batch.
        rates: learning rates at the first iteration.
        decay: factor of the rates from the first iteration to the last, exponential in between.
        static_share: share of a batch's rays that show the scene at rest.
        grow: by how many voxels the occupancy at rest grows first, where there may be something
            that no static view shows.
    """

    iterations: int = 1000
    rays: int = 8192
    rates: CanonicalRates = field(
        default_factory=lambda: CanonicalRates(density=0.01, color=5e-3, decoder=5e-5)
    )
    decay: float = 0.1
    static_share: float = 0.75
    grow: int = 0

    def __post_init__(self) -> None:
        key, share = "refinement.schedule", self.static_share
        for name, least in (("iterations", 0), ("rays", 1), ("grow", 0)):
            value = getattr(self, name)
            expect(value >= least, f"{key}.{name}", f"at least {least}", value)
        expect(0 < share < 1, f"{key}.static_share", "between 0 and 1", share)
        expect(0 < self.decay <= 1, f"{key}.decay", "above 0, at most 1", self.decay)


class RefinementStage(VoxelStage):
    """Learns density, features and decoder through the warps, which are frozen.

    Each batch has rays of the static views and of one random frame of the dynamic views.
    """

    schedule: RefinementSchedule
    name = "refinement"
    capture = "both"
    memory_keys = ("refinement.schedule.rays",)
    # Lists of samples are as long as these rays need: no capacity serves both captures.
    static_shape = False
    rate_keys = "refinement.schedule.rates or the weights of refinement.loss"

    def __init__(
        self,
        rest: LoadedCheckpoint,
        schedule: RefinementSchedule | None = None,
        loss: Mapping[str, float] = FINE_LOSS,
        pixels: Literal["all", "occupied"] = "all",
        iterations_per_step: int = 10,
        decoder_precision: Precision = "auto",
    ) -> None:
        """Build the stage.

        Args:
            rest: what the deformation stage learned.
            schedule: iterations, rays and rates.
            loss: weights of the photometric loss terms.
            pixels: ``all`` draws from the whole dynamic images; ``occupied`` from the pixels of
                the alpha mask and those whose rays hit something.
            iterations_per_step: optimiser iterations in one Lightning step.
            decoder_precision: what the colour network computes in.
        """
        super().__init__(iterations_per_step, "off", decoder_precision)
        self.schedule = schedule or RefinementSchedule()
        self.weights = counted_weights(loss, PHOTOMETRIC_TERMS, "refinement.loss")
        self.pixels = pixels
        self.scene_model = rest.model.requires_grad_(False)
        self.earlier_records = rest.metadata.records
        canonical = self.scene_model.canonical.requires_grad_(True)
        self.optimizer = field_optimizer(canonical, self.schedule.rates)
        self._static: PixelPool | None = None
        self._pools: list[PixelPool] = []
        self._occupancies: list[Occupancy] = []

    @property
    def total_iterations(self) -> int:
        """Iterations of the schedule."""
        return self.schedule.iterations

    @property
    def resolution(self) -> tuple[int, ...]:
        """Shape of the density and feature grids, which does not change."""
        return self.scene_model.canonical.density.shape

    def phase_at(self, iteration: int) -> Phase:
        """The one phase there is."""
        return Phase(kind="refinement", start=0, stop=self.total_iterations)

    def learning_rate_factor(self, iteration: int) -> float:
        """decay^(n / (N − 1)) at iteration n of N."""
        share = min(iteration / max(self.total_iterations - 1, 1), 1.0)
        return float(self.schedule.decay**share)

    def enter(self, phase: Phase) -> None:
        """Let the occupancy at rest grow, and prepare pixels, occupancies and optimiser."""
        occupancy = self.scene_model.occupancy
        if self.schedule.grow:
            occupancy.replace(dilate(occupancy.mask, self.schedule.grow))
        self.restore(phase, {})

    def restore(self, phase: Phase, state: dict[str, Any]) -> None:
        """Go on with ``phase``: images and fields tell which pixels there are."""
        self.phase, model = phase, self.scene_model
        times, moving = self.field.clock.times, self.training_views("dynamic")
        self._static = static_pool(self.training_views("static"), model, model.occupancy)
        self._occupancies, self._pools = [], []
        for frame in range(1, len(times)):
            occupancy = model.occupancy_at(times[frame])
            self._occupancies.append(occupancy)
            self._pools += frame_pools(
                moving,
                frame,
                model,
                occupancy,
                occupied_only=self.pixels == "occupied",
                join_views=True,
            )
        groups = self.optimizer.param_groups
        for number, group in enumerate(groups):
            skip_zero = group["name"] != "decoder"
            part = model.canonical.get_submodule(group["name"])
            self.optimizer.replace(number, list(part.parameters()), skip_zero=skip_zero)
        learned = [value for group in groups for value in group["params"]]
        self.bind(self.schedule.rays, [learned])

    def draw(self, batch: ParallelBatch) -> Pixels:
        """Random pixels: of static images first, then of one frame's dynamic images.

        Images are numbered through, the static ones first.
        """
        assert self._static is not None
        pick = torch.randint(
            len(self._pools), (), device=self.generator.device, generator=self.generator
        )
        moving = self.draw_pixels(self._pools[int(pick)])
        count = round(len(moving) * self.schedule.static_share)
        with span("batch"):
            image, flat = self._static.draw(count, self.generator)
            image = torch.cat([image, moving.image[count:] + len(self.training_views("static"))])
            return Pixels(image, torch.cat([flat, moving.flat[count:]]), moving.background)

    def loss(
        self, batch: ParallelBatch, views: tuple[Views, Views], pixels: Pixels
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean photometric loss of a batch's rays, and its terms."""
        model, (static, moving) = self.scene_model, views
        count = int((pixels.image < len(static)).sum())
        total, means = pixels.image.new_zeros((), dtype=torch.float32), dict[str, Tensor]()
        for shown, start, stop in ((static, 0, count), (moving, count, len(pixels))):
            if start == stop:
                continue
            part = pixels.between(start, stop)
            warp, occupancy, color_change = None, model.occupancy, None
            if shown is moving:
                part = Pixels(part.image - len(static), part.flat, part.background)
                assert moving.frames is not None
                frame = int(moving.frames[part.image[0]])
                time = self.field.clock.times[frame]
                warp, color_change = self.field.warp_at(time), model.color_change(time)
                occupancy = self._occupancies[frame - 1]
            seen = self.render_pixels(shown, part, occupancy, None, warp, color_change)
            with span("losses"):
                loss, terms = batch_loss(Prediction(*seen), PHOTOMETRIC_TERMS, self.weights)
                share = (stop - start) / len(pixels)
                total = total + share * loss
                for name, value in terms.items():
                    means[name] = means.get(name, 0.0) + share * value
        return total, means
