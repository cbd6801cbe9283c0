"""NSFF (Li et al., CVPR 2021): a static field, and one of each time whose points know their way."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.engine.ddp import rays_per_rank
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space, space_config, space_from
from devrf.methods.base import RayTrainable
from devrf.methods.nerf.occupancy_frames import OccupancyFrames, diagonal_step
from devrf.methods.nerf.placement import Placement
from devrf.methods.nerf.ray_samples import RaySamples
from devrf.methods.nerf.ray_view import RayView
from devrf.methods.nsff.fields import TwoFields
from devrf.methods.nsff.losses import TERMS, LossInput, missing_terms
from devrf.methods.nsff.priors import ImagePriors
from devrf.methods.nsff.renders import BlendedOutput, Renders
from devrf.methods.nsff.sampling import evenly
from devrf.methods.nsff.settings import NSFFSettings
from devrf.ops.compositing import color_and_depth, sum_by_ray
from devrf.rendering.output import RenderOutput
from devrf.scenes.scene import Scene, Views

log = logging.getLogger(__name__)

# The most that a point moves along an axis from a frame to the next, in normalised space.
REACH_IN_NDC, REACH_IN_A_BOX = 1.0, 0.2


class NSFF(RayTrainable):
    """S(x, d) → σ_s, c_s, v and D(x, t, d) → σ_d, c_d, f±, o±, composited in one pass."""

    name: ClassVar[str] = "nsff"
    losses: ClassVar[tuple[str, ...]] = tuple(TERMS)
    protocols: ClassVar[tuple[str, ...]] = ("joint", "dynamic")
    priors: ClassVar[tuple[str, ...]] = ("forward_flow",)

    times: Tensor

    def __init__(self, settings: NSFFSettings | None = None) -> None:
        """Build the networks.

        Args:
            settings: sizes, sampling, blending and schedule.
        """
        super().__init__()
        self.settings = settings or NSFFSettings()
        self.fields = TwoFields(self.settings)
        self.occupancy = OccupancyFrames(1, (2, 2, 2))
        self._step, self._absent = 0, frozenset[str]()
        self._images: ImagePriors | None = None
        box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
        self._place(box, WORLD, (0.0, 1.0), (0.0, 1.0), cut_out=True)

    def _place(
        self,
        box: Box,
        space: Space,
        limits: tuple[float, float],
        times: tuple[float, ...],
        *,
        cut_out: bool,
    ) -> None:
        self.box, self.space, self.depth_limits = box, space, limits
        self.clock, self._cut_out = FrameClock(times), cut_out
        self.register_buffer("times", torch.tensor(times, device=self.device), persistent=False)
        self.placement = Placement(box, space)
        reach = REACH_IN_NDC if isinstance(space, NormalizedDevice) else REACH_IN_A_BOX
        self.fields.dynamic.reach = self.settings.flow_reach or reach

    def setup(self, scene: Scene) -> None:
        """Take the scene's bounds and times; carve the frames' occupancy from their mattes."""
        bounds, s = scene.bounds, self.settings
        box = bounds.whole
        limits, times = (bounds.near, bounds.far), scene.clock.times
        cut_out = scene.static.train.cut_out or scene.dynamic.train.cut_out
        self._place(box, scene.space, limits, times, cut_out=cut_out)
        if s.sampling == "occupancy":
            self.occupancy = OccupancyFrames.of(
                scene, box, s.occupancy_side, self.device, hull=s.hull, empty_from=s.empty_from
            )

    @property
    def has_hull(self) -> bool:
        """Whether the occupancy was carved from mattes."""
        return self.occupancy.has_hull

    def config(self) -> dict[str, Any]:
        """Settings, and where and when the scene is."""
        return {
            "settings": asdict(self.settings),
            "box": [list(self.box.low), list(self.box.high)],
            "space": space_config(self.space),
            "limits": list(self.depth_limits),
            "times": list(self.clock.times),
            "cut_out": self._cut_out,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> NSFF:
        """Networks of the same sizes in the same place."""
        model = cls(NSFFSettings.of(config["settings"]))
        near, far = config["limits"]
        model._place(
            Box.of(*config["box"]),
            space_from(config["space"]),
            (near, far),
            tuple(config["times"]),
            cut_out=config["cut_out"],
        )
        return model

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The two fields."""
        fields = self.fields
        return {"static": fields.static.parameters(), "dynamic": fields.dynamic.parameters()}

    def on_iteration(self, step: int, total: int) -> None:
        """Remember the iteration: weights change every N₀. Look where the fields are empty."""
        self._step = step
        share = self.settings.empty_from
        self.occupancy.learned.follow(step, total, share, self.box, self._opacity)

    def _opacity(self, points: Tensor, time: Tensor) -> Tensor:
        """Opacity (S,) of a step at points (S, 3) and times (S,), of the denser field."""
        points, step = self.placement.normalised(points), self.box.diagonal / self.settings.steps
        still = self.fields.static.density_alone(points)
        moving = self.fields.dynamic.density_alone(
            torch.cat([points, 2 * time[:, None] - 1], dim=-1)
        )
        length = points.new_full((), step / self.placement.half_edge)
        depth = self.fields.optical_depth(torch.maximum(still, moving), length, 0.0)
        return -torch.expm1(-depth)

    @property
    def _first(self) -> int:
        """N₀."""
        return self.settings.warmup.steps(len(self.clock))

    @property
    def _endless(self) -> bool:
        """Whether the last sample of a ray stands for all behind it."""
        return not (self._cut_out and self.space.is_linear)

    def learn_from(self, views: Sequence[Views], terms: Collection[str]) -> None:
        """Look for priors; what is missing is said, and its terms are left out."""
        self._images = ImagePriors(views, self.space)
        missing = missing_terms(self._images, terms, additive=self.fields.additive)
        self._absent = frozenset(missing)
        if "flow" in terms and sum(self._images.has_flow) == 1:
            missing["half of flow"] = (
                f"no {'backward' if self._images.has_flow[0] else 'forward'} flow"
            )
        if self.settings.hard_rays and self._images.moving is None:
            missing["hard_rays"] = "no motion masks"
        if missing:
            said = ", ".join(f"{name} ({why})" for name, why in missing.items())
            log.info("nsff: zero, for what this scene and blend do not have: %s", said)

    def further_pixels(self, generator: torch.Generator) -> tuple[Tensor, Tensor] | None:
        """In the first N₀ iterations, pixels that move."""
        count = rays_per_rank(self.settings.hard_rays) if self.settings.hard_rays else 0
        images = self._images
        if images is None or images.moving is None or not count or self._step >= self._first:
            return None
        return images.moving.draw(count, generator)

    def forward(self, batch: RayBatch) -> BlendedOutput:
        """Render rays, each at its own time."""
        return self.render_rays(batch.rays, batch.time, batch.background, jitter=self.training)

    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> BlendedOutput:
        """What R rays in the fields' space see at ``time`` (R,).

        Args:
            rays: R rays.
            time: (R,) in [0, 1].
            background: (3,) or (R, 3) RGB.
            jitter: sample at random places, to learn from them.
        """
        samples = self._samples(rays, time, jitter=jitter)
        ray, fields = samples.ray, self.fields
        points = self.placement.normalised(samples.points)
        static = fields.static.at(points, rays.viewdirs, ray)
        dynamic = fields.dynamic.at(points, time.index_select(0, ray), rays.viewdirs, ray)
        noise = fields.noise(static.raw)
        depths = (
            fields.optical_depth(dynamic.raw, samples.length, noise),
            fields.optical_depth(static.raw, samples.length, noise),
        )
        blend = fields.blended(*depths, static.blend, ray, len(rays), endless=self._endless)
        moving, still = blend.dynamic[:, None], blend.static[:, None]
        seen = sum_by_ray(moving * dynamic.color + still * static.color, ray, len(rays))
        with torch.no_grad():
            weight = blend.dynamic + blend.static
            mass = sum_by_ray(weight, ray, len(rays))
            reached = sum_by_ray(weight * samples.distance, ray, len(rays))
        color, depth = color_and_depth(seen, reached, mass, blend.transmittance, background)
        return BlendedOutput(
            color=color,
            depth=depth,
            transmittance=blend.transmittance,
            samples=samples,
            points=points,
            static=static,
            dynamic=dynamic,
            depths=depths,
            blend=blend,
        )

    def _samples(self, rays: Rays, time: Tensor, *, jitter: bool) -> RaySamples:
        """Samples, their lengths in normalised units; without mattes the last one is endless."""
        s = self.settings
        if s.sampling == "occupancy":
            before, after, _ = self.clock.between(time)
            step = diagonal_step(self.box, rays, s.steps)
            samples = self.occupancy.march(
                rays, (before, after), self.box, self.depth_limits, step, jitter=jitter
            )
        else:
            samples = evenly(rays, self.box, self.depth_limits, s.samples, jitter=jitter)
        if self._endless:
            samples = samples.endless()
        return samples.scaled(self.placement.half_edge)

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """The terms of :data:`devrf.methods.nsff.losses.TERMS`, without those that are missing.

        Raises:
            DevrfError: nothing that counts is there.
        """
        assert isinstance(output, BlendedOutput)
        s = self.settings
        renders = Renders(
            self.fields,
            self.times,
            output,
            batch,
            both=s.neighbours == "both",
            weighted=self._step >= self._first,
        )
        given = LossInput(
            renders=renders,
            placement=self.placement,
            priors=self._images,
            step=self._step,
            chains="chained" in names and self._step >= s.warmup.chained_from * self._first,
            prior_factor=s.warmup.prior_factor(self._step, len(self.clock)),
        )
        terms = {name: TERMS[name](given) for name in names if name not in self._absent}
        if not terms:
            raise DevrfError("ray_stage.loss: this scene has nothing for any of its terms")
        return terms

    def batch_bytes(self, rays: int) -> int:
        """As of every method; the dynamic field is evaluated for up to three more frames."""
        s = self.settings
        again = 3 if s.neighbours == "both" else 2
        layers = [m for m in self.fields.dynamic.modules() if isinstance(m, nn.Linear)]
        more = again * sum(layer.out_features for layer in layers)
        count = s.samples if s.sampling == "stratified" else s.steps
        every = super().batch_bytes(rays + s.hard_rays) // 128
        return count * (every + 12 * (rays + s.hard_rays) * more)

    def at(self, time: float, *, half: bool = False) -> RayView:
        """The scene at ``time``."""
        at_rest = self.clock.at(time).after == 0
        return RayView(self, time, self.device, at_rest=at_rest, half=half)
