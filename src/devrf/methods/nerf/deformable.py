"""What D-NeRF, Nerfies and HyperNeRF are: a deformation before one radiance field."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space, space_config, space_from
from devrf.methods.base import RayTrainable
from devrf.methods.nerf.hierarchical import flattened, importance, limits, stratified
from devrf.methods.nerf.occupancy_frames import OccupancyFrames, diagonal_step
from devrf.methods.nerf.placement import Placement
from devrf.methods.nerf.radiance_field import RadianceField
from devrf.methods.nerf.ray_samples import RaySamples, volume_render
from devrf.methods.nerf.ray_view import RayView
from devrf.methods.nerf.settings import FieldSettings
from devrf.ops.compositing import composite
from devrf.rendering.output import RenderOutput
from devrf.scenes.scene import Scene
from devrf.system.device import multiplies_bfloat16


class DeformableField(RayTrainable):
    """(σ, c) = T(x′, w, d), where a deformation leads a point x at time t to x′ and w.

    A method says what the deformation is (:meth:`deform`). T lives in normalised space: the box
    that holds the scene, in world units, NDC or contracted, its longest edge being 2.

    Attributes:
        settings: sizes and sampling.
        ambient: length of w as it enters T; 0: there is none.
        canonical: T.
        coarse: a T of its own for the coarse samples, if the settings ask for one.
        occupancy: where something may be at each frame, with ``sampling=occupancy``.
        clock: the frames' times.
    """

    settings_class: ClassVar[type[FieldSettings]]
    coarse: RadianceField | None

    def __init__(self, settings: FieldSettings, ambient: int = 0) -> None:
        """Build the radiance field.

        Args:
            settings: sizes and sampling.
            ambient: length of w as it enters T; 0: there is none.
        """
        super().__init__()
        self.settings, self.ambient = settings, ambient
        self.canonical = settings.radiance_field(ambient)
        self.coarse = settings.radiance_field(ambient) if settings.separate_coarse else None
        self.occupancy = OccupancyFrames(1, (2, 2, 2))
        self._place(Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), WORLD, (0.0, 1.0))
        self.set_times((0.0, 1.0))

    @abstractmethod
    def deform(self, points: Tensor, time: Tensor) -> tuple[Tensor, Tensor | None]:
        """Where points lead, in normalised space.

        Args:
            points: (S, 3) x.
            time: (S,) in [0, 1].

        Returns:
            x′ (S, 3), and what enters T beside it, (S, ambient) or None.
        """

    def radiance_parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The radiance fields as parts; what takes w is a part of its own."""
        fields = [field for field in (self.canonical, self.coarse) if field is not None]
        own = [one for field in fields for one in field.own_parameters()]
        beside = [one for field in fields for one in field.ambient_parameters()]
        return {"canonical": own, "canonical_ambient": beside} if beside else {"canonical": own}

    def set_times(self, times: tuple[float, ...]) -> None:
        """Take the frames' times; a method with codes for them makes these here."""
        self.clock = FrameClock(times)

    def _place(self, box: Box, space: Space, depths: tuple[float, float]) -> None:
        self.box, self.space, self.depth_limits = box, space, depths
        self.placement = Placement(box, space)

    def setup(self, scene: Scene) -> None:
        """Take the scene's bounds and times; carve the frames' occupancy from their mattes."""
        bounds, s = scene.bounds, self.settings
        box = bounds.whole
        self._place(box, scene.space, (bounds.near, bounds.far))
        self.set_times(scene.clock.times)
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
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Networks of the same sizes in the same place."""
        model = cls(cls.settings_class(**config["settings"]))
        low, high = config["box"]
        near, far = config["limits"]
        model._place(Box.of(low, high), space_from(config["space"]), (near, far))
        model.set_times(tuple(config["times"]))
        return model

    def forward(self, batch: RayBatch) -> RenderOutput:
        """Render rays, each at its own time."""
        return self.render_rays(batch.rays, batch.time, batch.background, jitter=self.training)

    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> RenderOutput:
        """What R rays in the fields' space see at ``time`` (R,).

        Args:
            rays: R rays.
            time: (R,) in [0, 1].
            background: (3,) or (R, 3) RGB.
            jitter: sample at random places, to learn from them.

        Returns:
            ``extras`` has of the S samples ``points`` (S, 3) x in normalised space, ``time``,
            ``ray`` and ``weight`` (S,); and if a coarse field learns, ``coarse_color`` (R, 3) and
            the others with ``coarse_`` before their names.
        """
        first = None
        if self.settings.sampling == "occupancy":
            samples = self._march(rays, time, jitter=jitter)
        else:
            samples, first = self._by_weight(rays, time, background, jitter=jitter)
        seen = self._seen(self.canonical, samples, rays, time, background)
        extras = dict(seen.extras)
        if first is not None:
            extras["coarse_color"] = first.color
            extras |= {f"coarse_{name}": value for name, value in first.extras.items()}
        return RenderOutput(
            color=seen.color, depth=seen.depth, transmittance=seen.transmittance, extras=extras
        )

    def _seen(
        self,
        field: RadianceField,
        samples: RaySamples,
        rays: Rays,
        time: Tensor,
        background: Tensor,
    ) -> RenderOutput:
        """What samples of rays come to in a radiance field."""
        if not self.space.is_linear:
            samples = samples.endless()
        points, when = self.placement.normalised(samples.points), time.index_select(0, samples.ray)
        canonical, ambient = self.deform(points, when)
        with self._reduced():
            density, color = field(canonical, rays.viewdirs, samples.ray, ambient)
        seen = volume_render(
            samples.scaled(self.placement.half_edge), density.float(), color.float(), background
        )
        return RenderOutput(
            color=seen.color,
            depth=seen.depth,
            transmittance=seen.transmittance,
            extras={**seen.extras, "points": points, "time": when},
        )

    def _by_weight(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool
    ) -> tuple[RaySamples, RenderOutput | None]:
        """Even samples, and more where these have weight; what a learning coarse field sees."""
        s, field = self.settings, self.coarse or self.canonical
        near, far = limits(rays, self.box, self.depth_limits)
        distance = stratified(near, far, s.coarse, jitter=jitter)
        first, seen = flattened(rays, distance, far), None
        if self.coarse is not None and jitter:
            seen = self._seen(field, first, rays, time, background)
            weight = seen.extras["weight"].detach()
        else:
            weight = self._weights(field, first, time)
        with torch.no_grad():
            drawn = importance(distance, weight.view_as(distance), near, far, s.fine, jitter=jitter)
            distance, _ = torch.cat([distance, drawn], dim=1).sort(dim=1)
        return flattened(rays, distance, far), seen

    @torch.no_grad()
    def _weights(self, field: RadianceField, samples: RaySamples, time: Tensor) -> Tensor:
        """Weights (S,) of samples, from their densities alone."""
        points, when = self.placement.normalised(samples.points), time.index_select(0, samples.ray)
        with self._reduced():
            density = field.sigma(*self.deform(points, when))
        length = samples.length / self.placement.half_edge
        weight, _ = composite(density.float() * length, samples.ray, samples.rays)
        return weight

    def _march(self, rays: Rays, time: Tensor, *, jitter: bool) -> RaySamples:
        """Even steps where something may be at the frames around each ray's time."""
        before, after, _ = self.clock.between(time)
        step = diagonal_step(self.box, rays, self.settings.steps)
        return self.occupancy.march(
            rays, (before, after), self.box, self.depth_limits, step, jitter=jitter
        )

    def on_iteration(self, step: int, total: int) -> None:
        """Look where the field is empty."""
        share = self.settings.empty_from
        self.occupancy.learned.follow(step, total, share, self.box, self._opacity)

    def _opacity(self, points: Tensor, time: Tensor) -> Tensor:
        """Opacity (S,) of a step at points (S, 3) of the fields' space and times (S,)."""
        points = self.placement.normalised(points)
        step = self.box.diagonal / self.settings.steps / self.placement.half_edge
        with self._reduced():
            density = self.canonical.sigma(*self.deform(points, time))
        return -torch.expm1(-density.float() * step)

    def _reduced(self) -> AbstractContextManager[None]:
        """Where T learns in bfloat16, if it is to."""
        chosen = self.settings.precision
        reduced = multiplies_bfloat16(self.device) if chosen == "auto" else chosen == "bfloat16"
        if not (reduced and self.training):
            return nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``color``: the mean squared error, and that of the coarse colours where these learn."""
        if "color" not in names:
            return {}
        terms = super().loss_terms(output, batch, names)
        coarse = output.extras.get("coarse_color")
        if coarse is not None:
            terms["color"] = terms["color"] + nn.functional.mse_loss(coarse, batch.color)
        return terms

    def at(self, time: float, *, half: bool = False) -> RayView:
        """The scene at ``time``."""
        at_rest = self.clock.at(time).after == 0
        return RayView(self, time, self.device, at_rest=at_rest, half=half)
