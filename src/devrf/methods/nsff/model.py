"""NSFF (Li et al., CVPR 2021): a static field, and one of each time whose points know their way."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.rays import Rays
from devrf.geometry.space import Space
from devrf.methods.nerf.placed_model import NeuralField, RayView
from devrf.methods.nerf.samples import accumulated, flattened, limits, stratified
from devrf.methods.nsff.fields import BACKWARD, FORWARD, TwoFields, with_time
from devrf.methods.nsff.losses import TERMS, missing_terms
from devrf.methods.nsff.priors import ImagePriors
from devrf.methods.nsff.renders import BlendedOutput, Renders
from devrf.methods.nsff.settings import NSFFSettings
from devrf.ops.compositing import LEAST_MASS, sum_by_ray
from devrf.rendering.output import RenderOutput
from devrf.scenes.scene import Scene, Views

log = logging.getLogger(__name__)

# The most that a point moves along an axis from a frame to the next, in normalised space.
REACH_IN_NDC = 1.0
REACH_IN_A_BOX = 0.2


class NSFF(NeuralField):
    """S(x, d) → σ_s, c_s, v and D(x, t, d) → σ_d, c_d, f±, o±, composited in one pass.

    Attributes:
        fields: S and D.
        times: (T,) of the frames.
        cut_out: whether alpha masks cut the scene out.
    """

    name: ClassVar[str] = "nsff"
    losses: ClassVar[tuple[str, ...]] = tuple(TERMS)
    protocols: ClassVar[tuple[str, ...]] = ("joint", "dynamic")
    priors: ClassVar[tuple[str, ...]] = ("forward_flow",)
    settings_class = NSFFSettings
    checkpointed_attributes: ClassVar[Mapping[str, Any]] = {"cut_out": bool}
    settings: NSFFSettings
    times: Tensor

    def __init__(self, settings: NSFFSettings | None = None) -> None:
        """Build the networks, as published if no settings are given."""
        super().__init__(settings or NSFFSettings())
        self.fields = TwoFields(self.settings)
        self._step = 0
        self._absent = frozenset[str]()
        self.cut_out = True
        self._images: ImagePriors | None = None
        self.place()

    def set_place(self, box: Box, space: Space, depths: tuple[float, float]) -> None:
        """As for every method; in NDC points may move further."""
        super().set_place(box, space, depths)
        reach = REACH_IN_NDC if isinstance(space, NormalizedDevice) else REACH_IN_A_BOX
        self.fields.dynamic.reach = self.settings.flow_reach or reach

    def set_times(self, times: tuple[float, ...]) -> None:
        """Take the frames' times."""
        super().set_times(times)
        self.register_buffer("times", torch.tensor(times, device=self.device), persistent=False)

    def setup(self, scene: Scene) -> None:
        """As for every method, and find out whether alpha masks cut the scene out."""
        super().setup(scene)
        self.cut_out = scene.static.train.cut_out or scene.dynamic.train.cut_out

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The two fields."""
        fields = self.fields
        return {"static": fields.static.parameters(), "dynamic": fields.dynamic.parameters()}

    def milestones(self, total: int) -> dict[str, int]:
        """Iterations at which priors count less, and frames two steps away begin to count."""
        chained = round(self.settings.warmup.chained_from * self._first)
        changes = {"priors counted less": self._first, "frames two steps away counted": chained}
        return {**super().milestones(total), **{k: n for k, n in changes.items() if n < total}}

    def on_iteration(self, step: int, total: int) -> None:
        """Remember the iteration: weights change every N₀. Look where the fields are empty."""
        self._step = step
        super().on_iteration(step, total)

    def optical_depth(self, points: Tensor, time: Tensor, length: float) -> Tensor:
        """τ (S,) of the denser field."""
        static, _ = self.fields.static.sigma(points)
        dynamic, _ = self.fields.dynamic.sigma(with_time(points, time))
        return torch.maximum(static, dynamic) * length

    @property
    def _first(self) -> int:
        """N₀."""
        return self.settings.warmup.steps(len(self.clock))

    def prepare_priors(self, views: Sequence[Views], terms: Collection[str]) -> None:
        """Look for priors; the log names missing ones, whose terms are left out."""
        self._images = ImagePriors(views, self.space)
        missing = missing_terms(self._images, terms, additive=self.fields.additive)
        self._absent = frozenset(missing)
        forward, backward = self._images.has_flow
        if "flow" in terms and forward != backward:
            missing["half of flow"] = f"no {'backward' if forward else 'forward'} flow"
        if self.settings.hard_rays and self._images.moving is None:
            missing["hard_rays"] = "no motion masks"
        if missing:
            listed = ", ".join(f"{name} ({why})" for name, why in missing.items())
            log.info("nsff: zero, for what this scene and blend do not have: %s", listed)

    def extra_pixels(
        self, generator: torch.Generator, share: float
    ) -> tuple[Tensor, Tensor] | None:
        """Pixels that move, in the first N₀ iterations."""
        moving = None if self._images is None else self._images.moving
        if moving is None or not self.settings.hard_rays or self._step >= self._first:
            return None
        rays = max(1, round(self.settings.hard_rays * share))
        return moving.draw(rays, generator)

    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> BlendedOutput:
        """As for every method, with the parts of the render."""
        if self.settings.sampling == "occupancy":
            samples = self.march(rays, time, jitter=jitter)
        else:
            near, far = limits(rays, self.box, self.depth_limits)
            distance = stratified(near, far, self.settings.samples, jitter=jitter)
            samples = flattened(rays, distance, far)
        # If masks cut the scene out it ends with its box; else the last sample is all behind it.
        unbounded = not (self.cut_out and self.space.is_linear)
        samples = samples.unbounded() if unbounded else samples
        samples = samples.normalised(self.placement)
        ray = samples.ray
        fields = self.fields
        points = samples.points
        static = fields.static.at(points, rays.viewdirs, ray)
        dynamic = fields.dynamic.at(points, time.index_select(0, ray), rays.viewdirs, ray)
        noise = fields.noise(static.raw) if jitter else 0.0
        dynamic_depth = fields.optical_depth(dynamic.raw, samples.length, noise)
        static_depth = fields.optical_depth(static.raw, samples.length, noise)
        blend = fields.blended(
            dynamic_depth, static_depth, static.blend, ray, len(rays), unbounded=unbounded
        )
        weight = blend.dynamic + blend.static
        color = blend.dynamic[:, None] * dynamic.color + blend.static[:, None] * static.color
        output = accumulated(samples, weight, color, blend.transmittance, background)
        return BlendedOutput(
            color=output.color,
            depth=output.depth,
            transmittance=output.transmittance,
            samples=samples,
            static=static,
            dynamic=dynamic,
            depths=(dynamic_depth, static_depth),
            blend=blend,
        )

    def at(self, time: float) -> FlowingView:
        """The scene at ``time``."""
        return FlowingView(self, time)

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """The terms of :data:`devrf.methods.nsff.losses.TERMS`, without those that are missing.

        Raises:
            DevrfError: nothing that counts is there.
        """
        assert isinstance(output, BlendedOutput)
        warmup = self.settings.warmup
        step = self._step
        renders = Renders(
            fields=self.fields,
            placement=self.placement,
            times=self.times,
            priors=self._images,
            output=output,
            batch=batch,
            step=step,
            both=self.settings.neighbours == "both",
            weighted=step >= self._first,
            chains="chained" in names and step >= warmup.chained_from * self._first,
            prior_factor=warmup.prior_factor(step, len(self.clock)),
        )
        terms = {name: TERMS[name](renders) for name in names if name not in self._absent}
        if not terms:
            raise DevrfError("ray_stage.loss: this scene has nothing for any of its terms")
        return terms


class FlowingView(RayView):
    """NSFF at one time: dynamic points follow their flows, the rest stays."""

    def __init__(self, model: NSFF, time: float) -> None:
        """As for every method."""
        super().__init__(model, model.render_rays, time)
        self._model = model

    @torch.no_grad()
    def induced_flow(
        self, rays: Rays, pixels: Tensor, cameras: Cameras, time: float
    ) -> tuple[Tensor, Tensor]:
        """As for every :class:`~devrf.rendering.view.MovingView`."""
        now = torch.full_like(pixels[:, 0], self._time)
        black = torch.zeros_like(rays.origins[0])
        out = self._model.render_rays(rays, now, black)
        ray = out.samples.ray
        blend = out.blend
        there = self._moved(out.samples.points, rays.viewdirs, ray, time)
        placement = self._model.placement
        moving = cameras.project_into(0, placement.world(there))[0] - pixels[ray]
        still = cameras.project_into(0, placement.world(out.samples.points))[0] - pixels[ray]
        total = blend.dynamic[:, None] * moving + blend.static[:, None] * still
        mass = sum_by_ray(blend.dynamic + blend.static, ray, len(rays))
        return sum_by_ray(total, ray, len(rays)) / mass.clamp(min=LEAST_MASS)[:, None], mass

    def _moved(self, points: Tensor, viewdirs: Tensor, ray: Tensor, time: float) -> Tensor:
        """Dynamic points (S, 3), normalised, moved to ``time`` from frame to frame.

        If a step ends between two frames, that part of the flow counts.
        """
        clock = self._model.clock
        own = clock.at(self._time)
        other = clock.at(time)
        frame = own.before + own.weight
        last = other.before + other.weight
        while abs(last - frame) > clock.TOLERANCE:
            side = FORWARD if last > frame else BACKWARD
            step = min(abs(last - frame), 1.0)
            now = float(np.interp(frame, range(len(clock)), clock.times))
            when = torch.full_like(points[:, 0], now)
            flow = self._model.fields.dynamic.at(points, when, viewdirs, ray).flow
            points = points + step * flow[:, side]
            frame += step if side == FORWARD else -step
        return points
