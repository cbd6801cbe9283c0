"""The canonical stage: the static capture (docs/method.md#captures) → the scene at rest."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor

from devrf.data.batch import PixelPool
from devrf.engine.ddp import broadcast
from devrf.engine.grid_adam import GridAdam
from devrf.engine.stage import Stage, Terms
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.methods.batch import gather_batch
from devrf.methods.devrf.architecture import Architecture, fitted_to, resolved_voxels
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.canonical_schedule import (
    DIRECTIONS,
    GROWN,
    RENEWED,
    SEARCHED,
    SMOOTHED_LESS,
    CanonicalPhase,
    CanonicalSchedule,
)
from devrf.methods.devrf.depth_crop import crop_to_visible
from devrf.methods.devrf.free_space import possibly_occupied, searched_box, view_count_weight
from devrf.methods.devrf.losses import (
    PHOTOMETRIC_TERMS,
    Prediction,
    Weighted,
    apart_from_total_variation,
    batch_loss,
    total_variation_weight,
)
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.pixel_pools import pixels_for_epochs, static_pool
from devrf.methods.devrf.plans import CanonicalPlan
from devrf.methods.devrf.settings import (
    FINE_LOSS,
    SEARCH_LOSS,
    CanonicalRates,
    Sampling,
)
from devrf.methods.devrf.volume_rendering import render
from devrf.methods.weighted_loss import counted_weights
from devrf.ops.photometric import distortion
from devrf.rendering.occupancy import Occupancy, bounding_box, dilate
from devrf.rendering.output import VoxelOutput
from devrf.rendering.sampling import RenderSettings
from devrf.scenes.scene import CaptureName, Scene, Views
from devrf.scenes.silhouettes import SEARCH, motion_box
from devrf.system.profiling import span

log = logging.getLogger(__name__)

# Motion so far beyond the fields' box, as a share of its longest edge, is warned of; silhouettes of
# few views enclose more than what moves.
BEYOND = 0.2
# Two cells of the grid on which they are intersected, as a share of its longest edge.
SEARCHED_CELLS = 2 / 63


@dataclass(frozen=True)
class Objective:
    """Loss and thresholds of a kind of phase: the geometry search, or the radiance field.

    Attributes:
        weights: of the loss terms, by name.
        tv: ω of the total variation.
        alpha_threshold: samples of less opacity have no colour.
        occupancy_threshold: cells of less opacity are empty where the occupancy is renewed.
        searches: whether the whole box is looked at: all pixels are drawn, Adam steps in every
            voxel, and the rate of a voxel goes with the number of views that see it.
    """

    weights: Mapping[str, float]
    tv: float
    alpha_threshold: float
    occupancy_threshold: float
    searches: bool


class CanonicalStage(Stage):
    """Learns the canonical field from the static views (docs/method.md#canonical-stage).

    Attributes:
        scene_model: the canonical field and its occupancy.
        schedule: resolutions and iterations.
        objectives: loss and thresholds, by the kind of the phase.
        pool: the pixels that batches are drawn from.
    """

    scene_model: DeVRFModel
    schedule: CanonicalSchedule
    phase: CanonicalPhase | None
    name = "canonical"
    capture: CaptureName = "static"
    rate_keys = "schedule.rates or the weights of loss.fine"
    plan = CanonicalPlan

    def __init__(
        self,
        schedule: CanonicalSchedule | None = None,
        architecture: Architecture | None = None,
        rates: CanonicalRates | None = None,
        sampling: Sampling | None = None,
        search_loss: Mapping[str, float] = SEARCH_LOSS,
        fine_loss: Mapping[str, float] = FINE_LOSS,
        iterations_per_step: int = 10,
    ) -> None:
        """Build the stage; the defaults are the paper's for inward-facing scenes.

        Args:
            schedule: resolutions and iterations.
            architecture: sizes of the field.
            rates: learning rates.
            sampling: step lengths and thresholds of samples.
            search_loss: weights of the geometry search's terms; ``tv`` is that of both grids.
            fine_loss: of the radiance field's.
            iterations_per_step: optimiser iterations in one Lightning step.
        """
        super().__init__(iterations_per_step)
        self.batch_size.keys = ("schedule.canonical.side", "schedule.canonical.rays")
        self.schedule = schedule or CanonicalSchedule()
        self.architecture = architecture or Architecture()
        self.rates = rates or CanonicalRates()
        self.sampling = sampling or Sampling()
        self.objectives = {
            kind: self._objective(kind, loss)
            for kind, loss in (("search", search_loss), ("fine", fine_loss))
        }
        self.pool: PixelPool | None = None
        self._is_finished = False

    def iterate(self, views: Views) -> Terms:
        """Learn the scene at rest from one batch (docs/method.md#canonical-stage)."""
        model = self.scene_model
        with span("batch"):
            image, flat = self.draw()
            background = self.background(image, self.generator)
            per_pixel = model.settings.rays_per_pixel
            batch = gather_batch(views, image, flat, background, model.space, per_pixel)
        output = render(
            batch.rays,
            model.canonical,
            model.occupancy,
            model.settings,
            batch.background,
        )
        with span("losses"):
            prediction = Prediction(output=output, batch=batch)
            loss, terms = batch_loss(prediction, PHOTOMETRIC_TERMS, self.objective.weights)
            if not model.space.is_linear:
                loss, terms = self._with_distortion(loss, terms, output)
        self.optimise(loss)
        return {"loss": loss.detach(), **terms}

    def draw(self) -> tuple[Tensor, Tensor]:
        """Random pixels: the image of each (P,) and its row-major number there (P,), int64."""
        assert self.pool is not None
        schedule = self.schedule
        per_pixel = self.scene_model.settings.rays_per_pixel
        most = None
        if schedule.epochs is not None and not self.objective.searches:
            iterations = round(schedule.iterations / self.position.schedule_scale)
            most = pixels_for_epochs(schedule.epochs, len(self.pool), iterations)
        pixels = self.batch_size.rays(schedule.rays // per_pixel, most)
        return self.pool.draw(pixels, self.generator)

    def _objective(self, kind: str, loss: Mapping[str, float]) -> Objective:
        """The objective of a kind of phase, whose ``loss`` is weights with that of ``tv``."""
        sampling = self.sampling
        searches = kind == "search"
        key = f"loss.{kind}"
        weights, tv = apart_from_total_variation(loss, key)
        # The search begins far fainter than what counts as occupied at its end.
        faint = sampling.search_alpha_threshold
        return Objective(
            weights=counted_weights(weights, PHOTOMETRIC_TERMS, key),
            tv=tv,
            alpha_threshold=faint if searches else sampling.alpha_threshold,
            occupancy_threshold=faint if searches else sampling.occupancy_threshold,
            searches=searches,
        )

    @property
    def objective(self) -> Objective:
        """The objective of the present phase."""
        assert self.phase is not None
        return self.objectives[self.phase.kind]

    @property
    def views(self) -> Views:
        """The images that are learned from, on the stage's device."""
        return self.datamodule.training_views(self.images[0], self.device)

    def _with_distortion(self, loss: Tensor, terms: Terms, output: VoxelOutput) -> Weighted:
        """In unbounded space surfaces are drawn together; distances are in half edges."""
        model = self.scene_model
        half_edge = sum(model.space.inner(model.box).size) / 6
        samples = output.samples
        distance = samples.distance / half_edge
        spread = distortion(samples.weight, distance, samples.ray, len(output.color))
        if self.schedule.learns_directions(self.position.iteration):
            loss = loss + self.schedule.unbounded_distortion * spread
        return loss, {**terms, "distortion": spread.detach()}

    def setup(self, stage: str) -> None:
        """Build the field of the first phase in the scene's box."""
        super().setup(stage)
        if self.schedule.first_frames:
            self.images = ("at_rest",)
        if hasattr(self, "scene_model"):
            return
        side = self.schedule.side
        schedule, architecture = fitted_to(self.scene, self.schedule, self.architecture)
        self.schedule = schedule
        self.architecture = architecture
        if schedule.side != side:
            log.info(
                "schedule.canonical.side: %g is changed to %.4g for this scene", side, schedule.side
            )
        views = self.scene.training_views(self.images[0])
        if schedule.first_frames and self.scene.moves and views is self.scene.static.train:
            log.info(
                "schedule.canonical.first_frames: left out: the dynamic views differ from the "
                "static ones in size or masks, or are by one camera that moves"
            )
        first = schedule.phase(0)
        searches = self.objectives[first.kind].searches
        carve = schedule.visual_hull_init or not searches
        box = searched_box(self.scene, carve=carve)
        possible = possibly_occupied(
            self.scene,
            views,
            box,
            box.grid_shape(schedule.search_side**3),
            carve=schedule.visual_hull_init,
            min_views=schedule.min_views,
            device=self.trainer.strategy.root_device,  # the stage is moved there later
        )
        occupancy = Occupancy(possible, box)
        if searches:
            canonical = self.architecture.search_field(box, first.voxels)
        else:
            canonical = self._radiance_field(occupancy, first)
        self.scene_model = DeVRFModel(
            self.architecture,
            canonical,
            occupancy,
            self.render_settings(first),
            space=self.scene.space,
        )
        # Density, features and decoder, in this order of groups.
        self.optimizer = GridAdam(
            {
                "name": name,
                "params": list(canonical.get_submodule(name).parameters()),
                "lr": rate,
                "base_lr": rate,
            }
            for name, rate in asdict(self.rates).items()
        )

    def render_settings(self, phase: CanonicalPhase) -> RenderSettings:
        """Step lengths and thresholds of samples in a phase."""
        return RenderSettings(
            step=self.sampling.step,
            alpha_threshold=self.objectives[phase.kind].alpha_threshold,
            near=self.scene.bounds.near,
            far=self.scene.bounds.far,
            rays_per_pixel=self.sampling.rays_per_pixel,
            focal=float(self.scene.static.train.cameras.focal.median()),
        )

    def enter(self, phase: CanonicalPhase) -> None:
        """Make grids, occupancy, rays and optimiser ready for ``phase``."""
        previous = self.phase
        self.phase = phase
        if previous is not None and previous.kind != phase.kind:
            self._begin_fine(phase)
            self.events[SEARCHED] += 1
        elif previous is not None:
            self._grow(phase)
            self.events[GROWN] += 1
        self.restore(phase, {})

    def restore(self, phase: CanonicalPhase, state: dict[str, Any]) -> None:
        """Choose the pixels to learn from, and let the optimiser learn the present grids."""
        self.scene_model.settings = self.render_settings(phase)
        self._choose_pixels()
        self.setup_optimizer()

    def _choose_pixels(self) -> None:
        """Those whose rays meet occupied space; in the search, all."""
        occupancy = None if self.objective.searches else self.scene_model.occupancy
        self.pool = static_pool(self.views, self.scene_model, occupancy)
        if not len(self.pool):
            raise DevrfError(
                f"the field has become empty by iteration {self.position.iteration}: check "
                "data.background, data.box and data.near, or lower schedule.rates.density"
            )

    def _grow(self, phase: CanonicalPhase) -> None:
        """Give up what no camera sees, and give the field the resolution of ``phase``."""
        field = self.scene_model.canonical
        self._clear_unobserved()
        if self.schedule.crop:
            assert self.pool is not None
            crop_to_visible(self.scene_model, self.scene, self.views, self.pool)
        # Cropping leaves a share of the voxels that the field was built for.
        share = field.base_voxels / round(self.schedule.side**3)
        field.resize(round(phase.voxels * share))
        self._keep_occupied(self.opaque())
        field.density.values.data.sub_(self.schedule.density_drop)

    def _begin_fine(self, phase: CanonicalPhase) -> None:
        """Keep what the search found as the occupancy, and start the radiance field."""
        search = self.scene_model.canonical
        occupancy = self.scene_model.occupancy
        opaque = search.voxel_alpha(self.sampling.step) > self.sampling.occupancy_threshold
        occupancy.replace(dilate(opaque & occupancy.mask, 1))
        field = self._radiance_field(occupancy, phase).to(self.device)
        broadcast([*field.parameters()])  # each process has drawn a network of its own
        self.scene_model.canonical = field

    def _radiance_field(self, occupancy: Occupancy, phase: CanonicalPhase) -> CanonicalField:
        """A new radiance field in the tight box around what is occupied, enlarged for motion."""
        tight = bounding_box(occupancy.mask, occupancy.box)
        if tight is None:
            raise DevrfError(
                "the geometry search found nothing opaque in the box "
                f"{occupancy.box.low} to {occupancy.box.high}: check data.box, data.near and "
                "data.background, or give it more schedule.canonical.search_iterations"
            )
        bounds = self.scene.bounds
        if not self.scene.space.is_linear:
            box = occupancy.box
        elif bounds.motion is None:
            box = tight.scaled(bounds.scale)
            warn_of_motion_beyond(box, self.scene)
        else:
            box = tight.scaled(1.05).union(bounds.motion)
        if bounds.limited:
            box = box.clipped(bounds.box)
        share = 100 * occupancy.share
        log.info("%.1f%% of the searched box may be occupied; fields live in %s", share, box)
        whole = round(self.schedule.side**3)
        base_voxels = resolved_voxels(self.scene, self.schedule, box)
        voxels = round(phase.voxels * base_voxels / whole)
        field = self.architecture.radiance_field(box, voxels, base_voxels)
        if self.schedule.view_dependence_start:
            field.forget_directions()
        return field

    @torch.no_grad()
    def opaque(self) -> Tensor:
        """Mask (X, Y, Z) of the voxels that count as occupied at rest."""
        objective = self.objective
        threshold = objective.occupancy_threshold
        if not (objective.searches or self.scene_model.space.is_linear):
            # Fog in unbounded space clears until it is not coloured, and no further.
            threshold = max(threshold, objective.alpha_threshold)
        return self.scene_model.canonical.voxel_alpha(self.sampling.step) > threshold

    def remember(self) -> Callable[[], None]:
        """Keep the occupancy, which each renewal narrows."""
        occupancy = self.scene_model.occupancy
        mask, box = occupancy.mask, occupancy.box

        def restore() -> None:
            occupancy.replace(mask, box)
            self._choose_pixels()
            self._look_for_gradients()

        return restore

    def _keep_occupied(self, where: Tensor) -> None:
        """Keep of the occupancy what is within a voxel of ``where`` (X, Y, Z)."""
        occupancy = self.scene_model.occupancy
        field = self.scene_model.canonical
        before = occupancy.on(field.density.shape, field.box)
        occupancy.replace(dilate(where, 1) & before, field.box)

    @torch.no_grad()
    def _clear_unobserved(self) -> None:
        """In contracted space, occupy only what this phase's rays have reached.

        A voxel that no ray has reached had no gradient: Adam's second moment of it is still zero.
        After a rollback the phase is counted from there.
        """
        state = self.optimizer.state.get(self.scene_model.canonical.density.values)
        if state and not self.scene_model.space.is_linear:
            self._keep_occupied(state["square"][..., 0] > 0)

    def setup_optimizer(self) -> None:
        """Give the optimiser the present grids (docs/method.md#optimiser)."""
        objective = self.objective
        field = self.scene_model.canonical
        shape = field.density.shape
        side = max(shape if field.planes is None else shape[:2])
        smoothing = total_variation_weight(objective.tv, side, self.schedule.rays)
        along_z = 1.0 if field.planes is None else shape[2] / side
        per_voxel_lr = None
        if objective.searches:
            points = field.box.grid_points(shape, field.density.values)
            seen = view_count_weight(self.views.cameras, self.scene.space.to_world(points))
            per_voxel_lr = seen[..., None]
        for group, grid in ((0, field.density), (1, field.color)):
            self.optimizer.replace(
                group,
                list(grid.parameters()),
                per_voxel_lr=per_voxel_lr if grid is field.density else None,
                skip_zero=not objective.searches,
                smoothing=smoothing,
                along_z=along_z,
                touched_only=not self.schedule.smooths_all(self.position.iteration),
            )
        self._look_for_gradients()
        decoder = list(field.decoder.parameters())
        learned = self.optimizer.param_groups[2]["params"]
        is_learned = [id(parameter) for parameter in decoder] == [id(p) for p in learned]
        if self.schedule.restart_at_growth or not is_learned:
            self.optimizer.replace(2, decoder)

    def _look_for_gradients(self) -> None:
        """Have the optimiser read gradients only where samples may be, unless all are smoothed."""
        field = self.scene_model.canonical
        occupancy = self.scene_model.occupancy
        groups = self.optimizer.param_groups[:2]
        reached = None
        if groups[0]["skip_zero"] and (groups[0]["touched_only"] or not groups[0]["smoothing"]):
            near = occupancy.points_near(field.density.shape, field.box)
            reached = near.view(-1).nonzero()[:, 0].int()
        for group in groups:
            group["rows"] = reached

    def prepare(self) -> None:
        """At the schedule's iterations renew the occupancy, smooth less, and learn directions.

        A search in fewer iterations begins less faintly.
        """
        schedule = self.schedule
        if self.objective.searches:
            shorter = self.architecture.for_search(self.position.schedule_scale)
            self.scene_model.canonical.alpha_init = shorter.search_alpha_init
        groups = self.optimizer.param_groups[:2]
        every = schedule.occupancy_every
        iteration = self.position.iteration
        begin = schedule.search_iterations if iteration >= schedule.search_iterations else 0
        renews = every is not None and self.position.is_due(every, begin - every // 2)
        # A field that has diverged is DivergenceGuard's to set back.
        if renews and bool((opaque := self.opaque()).any()):
            self._keep_occupied(opaque)
            self._choose_pixels()
            self.events[RENEWED] += 1
        touched_only = not schedule.smooths_all(iteration)
        smooths_less = touched_only and not groups[0]["touched_only"]
        changed = renews or touched_only != groups[0]["touched_only"]
        self.events[SMOOTHED_LESS] += smooths_less
        for group in groups:
            group["touched_only"] = touched_only
        if changed:
            self._look_for_gradients()
        learns = schedule.learns_directions(iteration)
        begun = self.scene_model.canonical.learn_directions(learns)
        self.events[DIRECTIONS] += begun

    @torch.no_grad()
    def _finish(self) -> None:
        """Once all is learned empty what was never occupied: no deformed sample is to meet fog."""
        if self._is_finished or not self.is_complete:
            return
        self._is_finished = True
        self.scene_model.canonical.learn_directions(True)
        self._clear_unobserved()
        self._keep_occupied(self.opaque())
        self.scene_model.canonical.clear(~self.scene_model.occupancy.mask, alpha=1e-6)

    def on_validation_start(self) -> None:
        """Score at the end of a fit what is saved; what is loaded has been finished."""
        if self.trainer.state.fn == TrainerFn.FITTING:
            self._finish()

    def on_train_end(self) -> None:
        """Finish the field."""
        self._finish()
        super().on_train_end()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take a radiance field in place of the search's, if that is what was stored."""
        super().on_load_checkpoint(checkpoint)
        stored = checkpoint["state_dict"]
        fine = any(key.startswith("scene_model.canonical.decoder.") for key in stored)
        if fine and self.schedule.search_iterations:
            box = self.scene_model.canonical.box
            self.scene_model.canonical = self.architecture.radiance_field(box, 8, 8)


def warn_of_motion_beyond(box: Box, scene: Scene) -> None:
    """Say if silhouettes show motion where, outside the fields' ``box``, nothing is rendered."""
    views = scene.dynamic.train
    if not scene.moves or not views.cut_out:
        return
    area = scene.bounds.box.scaled(SEARCH).union(box)
    shown = motion_box(views, area)
    if shown is None:
        return
    faces = [(-1, box.low, shown.low, area.low), (1, box.high, shown.high, area.high)]
    beyond = [
        sign * (there - here)
        for sign, ours, theirs, ends in faces
        for here, there, end in zip(ours, theirs, ends, strict=True)
        # Where it is the area that ends, and not the silhouettes, nothing is known.
        if abs(end - there) > SEARCHED_CELLS * area.longest
    ]
    if max(beyond, default=0.0) > BEYOND * box.longest:
        log.warning(
            "data.bound_scale: the silhouettes show motion in %s, and fields live in %s; what "
            "leaves it is cut off: give data.bound_scale=auto",
            shown,
            box,
        )
