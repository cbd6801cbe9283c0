"""The canonical stage: static views → the scene at rest."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from devrf.checkpoints.bits import pack_bits, unpack_bits
from devrf.checkpoints.checkpoint import CheckpointMetadata, LoadedCheckpoint
from devrf.data.batch import Pixels, background_color, gather_batch
from devrf.data.pool import PixelPool, all_pixels, wanted_pixels
from devrf.engine.ddp import share
from devrf.engine.graphs import Graphs
from devrf.engine.parallel_batch import ParallelBatch
from devrf.engine.stage import Phase, ScheduledStage
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.free_space import possible_matter, view_count_weight
from devrf.methods.devrf.model import SceneModel
from devrf.methods.devrf.motion_losses import total_variation_weight
from devrf.methods.devrf.photometric_losses import PHOTOMETRIC_TERMS, Prediction, visibility
from devrf.methods.devrf.pixel_selection import rays_hit_occupied
from devrf.methods.devrf.schedules import CanonicalPhase, CanonicalSchedule
from devrf.methods.devrf.settings import FINE_LOSS, SEARCH_LOSS, CanonicalRates, Precision, Sampling
from devrf.methods.devrf.volume_rendering import RenderSettings
from devrf.methods.weighted_loss import WeightedLoss
from devrf.ops.adam import GridAdam
from devrf.rendering.occupancy import Occupancy, bounding_box, dilate
from devrf.scenes.scene import CaptureName, Views
from devrf.system.profiling import span

log = logging.getLogger(__name__)


class CanonicalStage(ScheduledStage):
    """Learns the canonical field of an inward-facing scene (method §2).

    First the coarse geometry is searched in the box of the scene's bounds; then the box is
    tightened around it and enlarged so that motion has room, and the radiance field is learned
    inside, on rays that meet the coarse geometry.
    """

    name: ClassVar[str] = "canonical"
    capture: ClassVar[CaptureName] = "static"

    def __init__(
        self,
        schedule: CanonicalSchedule | None = None,
        architecture: Architecture | None = None,
        rates: CanonicalRates | None = None,
        sampling: Sampling | None = None,
        search_loss: Mapping[str, float] = SEARCH_LOSS,
        fine_loss: Mapping[str, float] = FINE_LOSS,
        iterations_per_step: int = 10,
        graphs: Graphs = "auto",
        decoder_precision: Precision = "auto",
    ) -> None:
        """Build the stage; the defaults are the paper's for inward-facing scenes.

        Args:
            schedule: resolutions and iterations.
            architecture: sizes of the field.
            rates: learning rates.
            sampling: how rays are sampled.
            search_loss: weights of the loss terms while the coarse geometry is searched;
                ``tv`` is the total variation of both grids.
            fine_loss: their weights afterwards.
            iterations_per_step: optimiser iterations in one Lightning step.
            graphs: whether a GPU replays iterations from CUDA graphs: ``auto`` where it can.
            decoder_precision: what the colour network computes in; ``auto``: ``bfloat16`` on a
                GPU that multiplies it.
        """
        super().__init__(iterations_per_step, graphs, decoder_precision)
        self.schedule = schedule or CanonicalSchedule()
        self.architecture = architecture or Architecture()
        self.rates = rates or CanonicalRates()
        self.sampling = sampling or Sampling()
        self.losses, self.tv = {}, {}
        for kind, given in (("search", search_loss), ("fine", fine_loss)):
            weights = dict(given)
            self.tv[kind] = weights.pop("tv", 0.0)
            self.losses[kind] = WeightedLoss(PHOTOMETRIC_TERMS, weights)
        self._pool: PixelPool | None = None
        self.scene_model: SceneModel | None = None
        self._optimizer: GridAdam | None = None

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Present shape of the density and feature grids."""
        return self.model.canonical.density.shape

    @property
    def model(self) -> SceneModel:
        """The rest state learned so far."""
        assert self.scene_model is not None, "the stage has not been set up"
        return self.scene_model

    @property
    def model_now(self) -> SceneModel:
        """The same."""
        return self.model

    @property
    def optimizer(self) -> GridAdam:
        """Adam over density, features and decoder, in that order of groups."""
        assert self._optimizer is not None, "the stage has not been set up"
        return self._optimizer

    @property
    def memory_keys(self) -> tuple[str, ...]:
        """Grid sizes and rays."""
        return "schedule.canonical.side", "schedule.canonical.rays"

    @property
    def total_iterations(self) -> int:
        """Iterations of search and fine stage together."""
        return self.schedule.total

    def phase_at(self, iteration: int) -> Phase:
        """The schedule's phase."""
        return self.schedule.phase(iteration)

    def learning_rate_factor(self, iteration: int) -> float:
        """The schedule's exponential decay."""
        return self.schedule.learning_rate_factor(iteration)

    def setup(self, stage: str) -> None:
        """Build the field of the first phase in the scene's box."""
        super().setup(stage)
        if self.scene_model is not None:
            return
        box, first = self.scene.bounds.box, self.schedule.phase(0)
        side = self.schedule.search_side
        occupancy = Occupancy(
            possible_matter(self.scene, box.grid_shape(side**3), carve=self.schedule.carve), box
        )
        if first.kind == "search":
            canonical = self.architecture.search_field(box, first.voxels)
        else:
            canonical = self._radiance_field(occupancy, first)
        self.scene_model = SceneModel(
            canonical, occupancy, self._settings(first), space=self.scene.space
        )
        rates = self.rates
        self._optimizer = GridAdam(
            [
                {"params": list(canonical.density.parameters()), "lr": rates.density},
                {"params": list(canonical.color.parameters()), "lr": rates.color},
                {"params": list(canonical.decoder.parameters()), "lr": rates.decoder},
            ]
        )
        names = ("density", "color", "decoder")
        for name, group in zip(names, self._optimizer.param_groups, strict=True):
            group.update(name=name, base_lr=group["lr"])

    def _settings(self, phase: CanonicalPhase) -> RenderSettings:
        bounds, sampling = self.scene.bounds, self.sampling
        searching = phase.kind == "search"
        threshold = sampling.search_alpha_threshold if searching else sampling.alpha_threshold
        return RenderSettings(sampling.step, threshold, bounds.near, bounds.far)

    def enter(self, phase: Phase) -> None:
        """Make grids, occupancy, rays and optimiser ready for ``phase``."""
        assert isinstance(phase, CanonicalPhase)
        previous, self.phase = self.phase, phase
        views = self.scene.static.train
        self.model.settings = self._settings(phase)
        if isinstance(previous, CanonicalPhase) and previous.kind != phase.kind:
            self._begin_fine(phase)
        elif previous is not None:
            self.model.canonical.resize(phase.voxels)
            self._refresh_occupancy()
        self._pool = self._useful_pixels(views, everywhere=phase.kind == "search")
        self.setup_optimizer(views.cameras, skip_zero=phase.kind == "fine")

    def _begin_fine(self, phase: CanonicalPhase) -> None:
        """Tighten the box around what the search found, enlarge it, start the radiance field."""
        search, occupancy = self.model.canonical, self.model.occupancy
        found = search.voxel_alpha(self.sampling.step) > self.sampling.occupancy_threshold
        occupancy.replace(dilate(found & occupancy.mask, 1))
        self.model.canonical = self._radiance_field(occupancy, phase).to(self.device)

    def _radiance_field(self, occupancy: Occupancy, phase: CanonicalPhase) -> CanonicalField:
        """A new radiance field in the box around what is occupied, with room for motion."""
        tight = bounding_box(occupancy.mask, occupancy.box)
        if tight is None:
            raise DevrfError(
                "the geometry search found nothing opaque in the box "
                f"{occupancy.box.low} to {occupancy.box.high}: check data.box, data.near and "
                "data.background, or give it more schedule.canonical.search_iterations"
            )
        box = self._enlarged(tight)
        share = 100 * occupancy.share
        log.info("%.1f%% of the searched box may be occupied; fields live in %s", share, box)
        return self.architecture.radiance_field(box, phase.voxels, round(self.schedule.side**3))

    def _enlarged(self, box: Box) -> Box:
        """The box with room for motion: the scene's motion box, or a multiple of the box."""
        bounds = self.scene.bounds
        if bounds.motion is None:
            return box.scaled(bounds.scale)
        return box.scaled(1.05).union(bounds.motion)

    @torch.no_grad()
    def _refresh_occupancy(self) -> None:
        """Look again where something is, on the field's own grid, within what was occupied."""
        field = self.model.canonical
        found = dilate(field.voxel_alpha(self.sampling.step) > self.sampling.occupancy_threshold, 1)
        points = field.box.grid_points(field.density.shape, field.density.values)
        before = self.model.occupancy.at(points.view(-1, 3)).view(found.shape)
        self.model.occupancy.replace(found & before, field.box)

    def _useful_pixels(self, views: Views, *, everywhere: bool) -> PixelPool:
        """The pixels whose rays meet something that may be occupied."""
        images = torch.arange(len(views), device=self.device)
        if everywhere:
            return all_pixels(views, images)
        cameras = views.cameras.to(self.device)
        meeting = [
            rays_hit_occupied(cameras, image, self.model, self.model.occupancy)
            for image in range(len(views))
        ]
        pool = wanted_pixels(views, images, torch.stack(meeting))
        if not len(pool):
            raise DevrfError(
                f"the field has become empty by iteration {self.iteration}: check data.background, "
                "data.box and data.near, or lower schedule.rates.density"
            )
        return pool

    def setup_optimizer(self, cameras: Cameras, *, skip_zero: bool) -> None:
        """Give the optimiser the present grids, each voxel paced by how many views see it.

        The total variation of both is smoothed at the voxels that a batch has touched.
        """
        assert isinstance(self.phase, CanonicalPhase)
        field = self.model.canonical
        smoothing = total_variation_weight(
            self.tv[self.phase.kind], max(field.density.shape), self.schedule.rays
        )
        pace = None
        if not skip_zero:
            points = field.box.grid_points(field.density.shape, field.density.values)
            points = self.scene.space.to_world(points)
            pace = view_count_weight(cameras.to(self.device), points)[..., None]
        for group, grid in ((0, field.density), (1, field.color)):
            self.optimizer.replace(
                group,
                list(grid.parameters()),
                pace=pace,
                skip_zero=skip_zero,
                smoothing=smoothing,
                touched_only=True,
            )
        decoder = list(field.decoder.parameters())
        if [id(p) for p in decoder] != [id(p) for p in self.optimizer.param_groups[2]["params"]]:
            self.optimizer.replace(2, decoder)
        groups = self.optimizer.param_groups
        self.renew(self.schedule.rays, [[p for group in groups for p in group["params"]]])

    def draw(self, lane: ParallelBatch) -> Pixels:
        """Random pixels of all images."""
        assert self._pool is not None
        with span("batch"):
            image, flat = self._pool.draw(share(self.schedule.rays), self.generator)
            background = background_color(self.scene.background, len(image), self.generator)
            return Pixels(image, flat, background)

    def loss(
        self, lane: ParallelBatch, views: Views, pixels: Pixels
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Render a batch of pixels and compare it with the images."""
        assert isinstance(self.phase, CanonicalPhase)
        with span("batch"):
            batch = gather_batch(
                views, pixels.image, pixels.flat, pixels.background, self.scene.space
            )
        output = self.see(batch.rays, self.model.occupancy, batch.background, lane.room)
        prediction = Prediction(output, batch)
        with span("losses"):
            total, terms = self.losses[self.phase.kind](prediction)
            return total, {**terms, **visibility(prediction)}

    @torch.no_grad()
    def on_train_end(self) -> None:
        """Empty what was never occupied, so that no deformed sample meets leftover fog."""
        if self.iteration < self.total_iterations:
            return
        self._refresh_occupancy()
        self.model.canonical.clear(~self.model.occupancy.mask, alpha=1e-6)

    def resize_to(self, state: dict[str, Tensor]) -> None:
        """Take a radiance field in place of the search's, if that is what was stored."""
        fine = any(key.startswith("scene_model.canonical.decoder.") for key in state)
        if fine and self.schedule.search_iterations:
            box = self.model.canonical.box
            self.model.canonical = self.architecture.radiance_field(box, 8, 8)

    def phase_state(self) -> dict[str, Any]:
        """The pixels that batches are drawn from."""
        assert self._pool is not None
        views = self.scene.static.train
        images = torch.arange(len(views), device=self.device)
        return {"pixels": pack_bits(self._pool.mask(images, views.height * views.width))}

    def restore_phase(self, phase: Phase, kept: dict[str, Any]) -> None:
        """Go on with ``phase``, the field being loaded."""
        assert isinstance(phase, CanonicalPhase)
        views = self.scene.static.train
        self.model.settings = self._settings(phase)
        shape = (len(views), views.height * views.width)
        images = torch.arange(len(views), device=self.device)
        self._pool = PixelPool.of_mask(images, unpack_bits(kept["pixels"], shape, self.device))
        self.setup_optimizer(views.cameras, skip_zero=phase.kind == "fine")

    def metadata(self) -> CheckpointMetadata:
        """What the checkpoint is, and how to build its model."""
        return CheckpointMetadata(
            scene=self.scene.name,
            fingerprint=self.scene.fingerprint,
            architecture=self.architecture,
            settings=self.model.settings,
            space=self.model.space,
            records={"canonical": self.record},
            training_config=self.training_config,
            complete=self.iteration >= self.total_iterations,
        )

    def result(self) -> LoadedCheckpoint:
        """What the deformation stage builds on."""
        return LoadedCheckpoint(self.metadata(), self.model)
