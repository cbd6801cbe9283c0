"""The peers' common base: methods placed in a scene, and networks whose empty space rays skip."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any, ClassVar, Generic, Self

import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space, space_config, space_from
from devrf.methods.base import Batch, RayTrainable, Trainable
from devrf.methods.nerf.occupancy import OccupancyFrames
from devrf.methods.nerf.placement import Placement
from devrf.methods.nerf.samples import RaySamples, accumulated
from devrf.ops.compositing import composite
from devrf.rendering.output import RenderedImage, RenderOutput
from devrf.rendering.view import SurfaceField
from devrf.scenes.scene import Scene
from devrf.system.plain_data import validate

# Rays of a view that are rendered at once: a CPU's caches hold them at a hundred samples a ray; a
# GPU is kept busy.
ON_CPU = 256
ON_GPU = 2**14
# Points along an edge of a cube of the box's size, from which a surface is extracted.
SURFACE_SIDE = 128


class PlacedModel(Trainable[Batch], Generic[Batch]):
    """A method with settings, placed in a box of the scene, whose frames it knows.

    Attributes:
        settings_class: the class of :attr:`settings`: sizes and sampling.
        checkpointed_attributes: further attributes that a checkpoint holds, with their types.
        placement: the maps from the fields' space (world units, NDC or contracted) to normalised
            space, where the box's longest edge is 2, and back.
        clock: the frames' times.
    """

    settings_class: ClassVar[type[Any]]
    checkpointed_attributes: ClassVar[Mapping[str, Any]] = {}
    settings: Any

    def __init__(self, settings: Any) -> None:
        super().__init__()
        self.settings = settings

    def place(self) -> None:
        """Build the parts that depend on the scene, for one at rest in a cube around the origin."""
        self.set_place(Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), WORLD, (0.0, 1.0))
        self.set_times((0.0, 1.0))

    def set_place(self, box: Box, space: Space, depths: tuple[float, float]) -> None:
        """Take the box, the fields' space, and the distances between which rays are sampled."""
        self.box = box
        self.space = space
        self.depth_limits = depths
        self.placement = Placement(box, space)

    def set_times(self, times: tuple[float, ...]) -> None:
        """Take the frames' times; a method with codes for them builds these here."""
        self.clock = FrameClock(times)

    def rehearsed(self, factor: float) -> Self:
        """The method with smaller settings."""
        return type(self)(self.settings.rehearsed(factor))

    def config(self) -> dict[str, Any]:
        """Settings, and the scene's box, space, depth limits and times."""
        return {
            "settings": asdict(self.settings),
            "box": [list(self.box.low), list(self.box.high)],
            "space": space_config(self.space),
            "limits": list(self.depth_limits),
            "times": list(self.clock.times),
            **{name: getattr(self, name) for name in self.checkpointed_attributes},
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Networks of the same sizes in the same place.

        Raises:
            ValueError | KeyError: a value is missing, or of another type.
        """
        model = cls(validate(cls.settings_class, config["settings"]))
        low, high = config["box"]
        box = validate(Box, {"low": low, "high": high})
        depths = validate(tuple[float, float], config["limits"])
        model.set_place(box, space_from(config["space"]), depths)
        model.set_times(validate(FrameClock, config).times)
        for name, kind in cls.checkpointed_attributes.items():
            setattr(model, name, validate(kind, config[name]))
        return model


class PlacedRays(PlacedModel[RayBatch], RayTrainable):
    """One that renders rays.

    Attributes:
        occupancy: an upper bound at each frame.
    """

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.occupancy = OccupancyFrames(1, (2, 2, 2))

    @property
    def has_hull(self) -> bool:
        """Whether the occupancy was carved from alpha masks."""
        return self.occupancy.has_hull


class NeuralField(PlacedRays):
    """Networks that are evaluated point by point, in normalised space."""

    def setup(self, scene: Scene) -> None:
        """Take the scene's bounds and times; carve the frames' occupancy from their alpha masks."""
        bounds = scene.bounds
        s = self.settings
        self.set_place(bounds.whole, scene.space, (bounds.near, bounds.far))
        self.set_times(scene.clock.times)
        if s.sampling == "occupancy":
            self.occupancy = OccupancyFrames.of(
                scene, self.box, s.occupancy_side, hull=s.hull, empty_from=s.empty_from
            ).to(self.device)

    def milestones(self, total: int) -> dict[str, int]:
        """The iteration from which space that the fields leave empty is skipped, if it is."""
        share = self.settings.empty_from
        learns = share is not None and self.occupancy.learned.opacity.numel() > 0
        return {"empty space left out": round(share * total)} if learns else {}

    def on_iteration(self, step: int, total: int) -> None:
        """Update the space that the fields leave empty."""
        share = self.settings.empty_from
        self.occupancy.learned.follow(step, total, share, self.box, self.opacity)

    @property
    def step_length(self) -> float:
        """The distance between even samples, in the fields' space."""
        return self.box.diagonal / float(self.settings.steps)

    def opacity(self, points: Tensor, time: Tensor) -> Tensor:
        """Opacity (S,) of a step at points (S, 3) of the fields' space and times (S,)."""
        length = self.step_length / self.placement.half_edge
        depth = self.optical_depth(self.placement.normalised(points), time, length)
        return -torch.expm1(-depth)

    @abstractmethod
    def optical_depth(self, points: Tensor, time: Tensor, length: float) -> Tensor:
        """τ (S,) of ways of ``length`` at points (S, 3) and times (S,), in normalised space."""

    @abstractmethod
    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> RenderOutput:
        """The render of R rays in the fields' space at ``time`` (R,).

        Args:
            rays: R rays.
            time: (R,) in [0, 1].
            background: (3,) or (R, 3) RGB.
            jitter: sample at random positions, to learn from them.
        """

    def forward(self, batch: RayBatch) -> RenderOutput:
        """Render rays, each at its own time."""
        return self.render_rays(batch.rays, batch.time, batch.background, jitter=self.training)

    def march(self, rays: Rays, time: Tensor, *, jitter: bool) -> RaySamples:
        """Even steps through the space occupied at the frames around each ray's time."""
        before, after, _ = self.clock.between(time)
        # In units of the longest direction.
        longest = float(rays.directions.norm(dim=1).amax()) if len(rays) else 1.0
        step = self.step_length / longest
        return self.occupancy.march(
            rays, (before, after), self.box, self.depth_limits, step, jitter=jitter
        )

    def at(self, time: float) -> RayView:
        """The scene at ``time``."""
        return RayView(self, self.render_rays, time)


# Points (S, 3) in normalised space, times (R,) of rays, and the ray (S,) int64 of each point →
# densities (S,) per unit of that space, and features (S, ·) that colours are made of.
Sigma = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
# Such features, unit viewing directions (R, 3) of rays, and the ray of each → RGB (S, 3).
Color = Callable[[Tensor, Tensor, Tensor], Tensor]


class DensityColorField(NeuralField):
    """A density and a colour at each point and time, their render and their surface.

    Attributes:
        least_weight: samples with no more weight are not coloured; 0: all are.
    """

    least_weight: float = 0.0

    @abstractmethod
    def sigma(self, points: Tensor, time: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
        """σ (S,) and the features for :meth:`rgb`; see :data:`Sigma`."""

    @abstractmethod
    def rgb(self, features: Tensor, viewdirs: Tensor, ray: Tensor) -> Tensor:
        """RGB (S, 3) in [0, 1]; see :data:`Color`."""

    def optical_depth(self, points: Tensor, time: Tensor, length: float) -> Tensor:
        """τ (S,) = σ · length."""
        each = torch.arange(len(points), device=points.device)
        return self.sigma(points, time, each)[0] * length

    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> RenderOutput:
        """The render by even steps; ``extras`` as of :meth:`rendered`."""
        return self.rendered(self.march(rays, time, jitter=jitter), rays, time, background)

    def rendered(
        self,
        samples: RaySamples,
        rays: Rays,
        time: Tensor,
        background: Tensor,
        *,
        sigma: Sigma | None = None,
        rgb: Color | None = None,
    ) -> RenderOutput:
        """The render of samples in the fields' space, or by another ``sigma`` and ``rgb``.

        ``extras`` describes the K samples that were coloured: ``points`` (K, 3) in normalised
        space, ``time``, ``ray``, ``distance`` (in units of the ray's direction) and ``weight``
        (K,), and ``sample_color`` (K, 3).
        """
        if not self.space.is_linear:
            samples = samples.unbounded()
        samples = samples.normalised(self.placement)
        density, features = (sigma or self.sigma)(samples.points, time, samples.ray)
        depth = density * samples.length
        weight, transmittance = composite(depth, samples.ray, samples.rays)
        if self.least_weight > 0:
            visible = (weight > self.least_weight).nonzero()[:, 0]
            samples = samples[visible]
            weight = weight.index_select(0, visible)
            features = features.index_select(0, visible)
        color = (rgb or self.rgb)(features, rays.viewdirs, samples.ray)
        output = accumulated(samples, weight, weight[:, None] * color, transmittance, background)
        extras = {
            "points": samples.points,
            "time": time.index_select(0, samples.ray),
            "ray": samples.ray,
            "distance": samples.distance,
            "weight": weight,
            "sample_color": color,
        }
        return replace(output, extras=extras)

    def surface_at(self, time: float) -> SurfaceField:
        """The scene at ``time``."""
        return SurfaceAtTime(self, time)


class SurfaceAtTime:
    """A model's field at one time.

    Attributes:
        box: the fields' box.
        shape: points of a grid over it, as fine as most such fields.
    """

    def __init__(self, model: DensityColorField, time: float) -> None:
        self.box = model.box
        self.shape = model.box.grid_shape(SURFACE_SIDE**3)
        self._model = model
        self._time = time

    @torch.no_grad()
    def optical_depth(self, points: Tensor) -> Tensor:
        """τ (M,) of a way of one voxel at ``points`` (M, 3) of the fields' space."""
        model = self._model
        moment = model.clock.at(self._time)
        frames = (moment.before, moment.after)
        index = model.occupancy.may_be_at(points, frames, self.box).nonzero()[:, 0]
        position = model.placement.normalised(points[index])
        voxel = self.box.voxel_size(math.prod(self.shape)) / model.placement.half_edge
        depth = model.optical_depth(position, torch.full_like(position[:, 0], self._time), voxel)
        return torch.zeros_like(points[:, 0]).index_copy(0, index, depth)

    @torch.no_grad()
    def color(self, points: Tensor, viewdirs: Tensor) -> Tensor:
        """RGB (M, 3) at ``points`` (M, 3) of the fields' space, along directions (M, 3)."""
        position = self._model.placement.normalised(points)
        time = torch.full_like(position[:, 0], self._time)
        each = torch.arange(len(points), device=points.device)
        return self._model.rgb(self._model.sigma(position, time, each)[1], viewdirs, each)


class RayView:
    """A model at one time.

    Attributes:
        at_rest: whether the time shows the rest state.
        chunk: rays that are best rendered at once.
    """

    def __init__(
        self,
        model: PlacedRays,
        render_rays: Callable[[Rays, Tensor, Tensor], RenderOutput],
        time: float,
    ) -> None:
        """Render ``model`` at one time.

        Args:
            model: the model.
            render_rays: as :meth:`NeuralField.render_rays`.
            time: in [0, 1].
        """
        on_gpu = model.device.type == "cuda"
        self._render_rays = render_rays
        self._time = time
        self.at_rest = model.clock.at(time).after == 0
        self.chunk = ON_GPU if on_gpu else ON_CPU

    @torch.no_grad()
    def render(self, rays: Rays, background: Tensor) -> RenderedImage:
        """The render of R rays in the fields' space."""
        time = torch.full_like(rays.origins[:, 0], self._time)
        return RenderedImage.of(self._render_rays(rays, time, background))
