"""Refines the canonical field from static and dynamic views (docs/method.md#refinement)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor, nn

from devrf.data.batch import PixelPool, Pixels
from devrf.engine.batches import frame_pools, static_pool
from devrf.errors import DevrfError
from devrf.methods.devrf.losses import PHOTOMETRIC_TERMS, VISIBILITY, Prediction
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import FINE_LOSS, CanonicalRates
from devrf.methods.devrf.voxel_stage import VoxelStage
from devrf.methods.devrf.weighted_loss import WeightedLoss
from devrf.rendering.occupancy import Occupancy, dilate
from devrf.scenes.scene import Views
from devrf.system.profiling import span


@dataclass(frozen=True)
class RefinementSettings:
    """How the canonical field learns from both captures after the deformation's levels.

    Attributes:
        iterations: of the phase; 0: the canonical field stays as the canonical stage left it.
        rates: learning rates at the first iteration.
        decay: factor of the rates from the first iteration to the last, exponential in between.
        static_share: share of a batch's rays that show the scene at rest.
        grow: by how many voxels the occupancy at rest grows first, where there may be matter
            that no static view shows.
    """

    iterations: int = 0
    rates: CanonicalRates = field(
        default_factory=lambda: CanonicalRates(density=0.01, color=5e-3, decoder=5e-5)
    )
    decay: float = 0.1
    static_share: float = 0.75
    grow: int = 0

    def __post_init__(self) -> None:
        for name in ("iterations", "grow"):
            if getattr(self, name) < 0:
                raise DevrfError(
                    f"schedule.refinement.{name}: expected 0 or more, not {getattr(self, name)}"
                )
        if not 0 < self.static_share < 1:
            raise DevrfError(
                "schedule.refinement.static_share: expected above 0, below 1, "
                f"not {self.static_share}"
            )
        if not 0 < self.decay <= 1:
            raise DevrfError(
                f"schedule.refinement.decay: expected above 0, at most 1, not {self.decay}"
            )


@dataclass(frozen=True)
class RefinementPhase:
    """The last phase of the deformation stage.

    Attributes:
        start: first iteration.
        stop: one past the last iteration.
        decay: factor of the learning rates over the phase.
    """

    start: int
    stop: int
    decay: float
    frames: tuple[int, ...] = ()
    kind: str = "refinement"

    def learning_rate_factor(self, iteration: int) -> float:
        """The rates at ``iteration``, as a share of those at the first."""
        done = (iteration - self.start) / max(self.stop - 1 - self.start, 1)
        return float(self.decay ** min(done, 1.0))


class Refinement:
    """Learns density, features and decoder through the warps, which are frozen.

    Each batch has rays of the static views and of one random frame of the dynamic views.
    """

    def __init__(
        self,
        stage: VoxelStage,
        settings: RefinementSettings,
        loss: Mapping[str, float] = FINE_LOSS,
    ) -> None:
        """Say what is refined, and how.

        Args:
            stage: the stage whose model is refined.
            settings: iterations and rates.
            loss: weights of the photometric loss terms.
        """
        self.settings = settings
        self._losses = WeightedLoss(PHOTOMETRIC_TERMS, dict(loss), VISIBILITY)
        # Not an attribute: a stage would hold itself.
        self._stage = stage
        self._still: PixelPool | None = None
        self._pools: list[PixelPool] = []
        self._occupancies: list[Occupancy] = []

    def phase(self, start: int) -> RefinementPhase:
        """The phase, beginning at iteration ``start``."""
        return RefinementPhase(start, start + self.settings.iterations, self.settings.decay)

    def add_groups(self) -> None:
        """Give the stage's optimiser a group, empty as yet, for each part of the field."""
        for name, rate in asdict(self.settings.rates).items():
            group = {"params": [], "lr": rate, "base_lr": rate, "name": name}
            self._stage.optimizer.add_param_group(group)

    @torch.no_grad()
    def grow(self) -> None:
        """Let the occupancy at rest grow to where matter may be that no static view shows."""
        occupancy = self._stage.scene_model.occupancy
        if self.settings.grow:
            occupancy.replace(dilate(occupancy.mask, self.settings.grow))

    def begin(self, moving: Views, *, occupied_only: bool) -> None:
        """Prepare pixels, occupancies and optimiser; the warps are final.

        Args:
            moving: the dynamic training views.
            occupied_only: learn only from pixels whose rays hit something occupied.
        """
        stage, model = self._stage, self._stage.scene_model
        assert model.deformation is not None
        times = model.deformation.clock.times
        self._still = static_pool(self._static_views, model, model.occupancy)
        self._occupancies, self._pools = [], []
        for frame in range(1, len(times)):
            occupancy = model.occupancy_at(times[frame])
            chosen = {"occupied_only": occupied_only, "join_views": True}
            self._occupancies.append(occupancy)
            self._pools += frame_pools(moving, frame, model, occupancy, **chosen)
        self._give_parameters(model)
        groups = stage.optimizer.param_groups
        learned = [value for group in groups for value in group["params"]]
        # Lists of samples are as long as these rays need: no capacity serves both captures.
        stage.bind(stage.schedule.rays, [learned], static_shape=False)

    def _give_parameters(self, model: DeVRFModel) -> None:
        model.canonical.requires_grad_(True)
        for number, group in enumerate(self._stage.optimizer.param_groups):
            if group["name"] not in asdict(self.settings.rates):
                self._stage.optimizer.replace(number, [])
                continue
            part: nn.Module = model.canonical.get_submodule(group["name"])
            skip_zero = group["name"] != "decoder"
            self._stage.optimizer.replace(number, list(part.parameters()), skip_zero=skip_zero)

    @property
    def _static_views(self) -> Views:
        return self._stage.training_views("static")

    def draw(self) -> Pixels:
        """Random pixels: of static images first, then of one frame's dynamic images.

        Images are numbered through, the static ones first.
        """
        assert self._still is not None
        generator, stage = self._stage.generator, self._stage
        pick = torch.randint(len(self._pools), (), device=generator.device, generator=generator)
        drawn = stage.draw_pixels(self._pools[int(pick)])
        still = round(len(drawn) * self.settings.static_share)
        with span("batch"):
            image, flat = self._still.draw(still, generator)
            image = torch.cat([image, drawn.image[still:] + len(self._static_views)])
            return Pixels(image, torch.cat([flat, drawn.flat[still:]]), drawn.background)

    def loss(self, moving: Views, pixels: Pixels) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean photometric loss of a batch's rays, and its terms."""
        model, still = self._stage.scene_model, self._static_views
        count = int((pixels.image < len(still)).sum())
        total, means = pixels.image.new_zeros((), dtype=torch.float32), dict[str, Tensor]()
        for views, start, stop in ((still, 0, count), (moving, count, len(pixels))):
            if start == stop:
                continue
            part = pixels.between(start, stop)
            warp, occupancy, appearance = None, model.occupancy, None
            if views is moving:
                part = Pixels(part.image - len(still), part.flat, part.background)
                assert views.frames is not None and model.deformation is not None
                frame = int(views.frames[part.image[0]])
                time = model.deformation.clock.times[frame]
                warp, appearance = model.deformation.warp_at(time), model.residual(time)
                occupancy = self._occupancies[frame - 1]
            seen = self._stage.render_pixels(views, part, occupancy, None, warp, appearance)
            with span("losses"):
                loss, terms = self._losses(Prediction(*seen))
                share = (stop - start) / len(pixels)
                total = total + share * loss
                for name, value in terms.items():
                    means[name] = means.get(name, 0.0) + share * value
        return total, means

    def end(self) -> None:
        """Freeze the field again; drop what only the phase needs."""
        self._stage.scene_model.canonical.requires_grad_(False)
        self._still, self._pools, self._occupancies = None, [], []
