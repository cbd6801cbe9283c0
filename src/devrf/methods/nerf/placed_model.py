"""What four peers share: networks placed in a scene, whose empty space rays skip."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, ClassVar, Self

from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space, space_config, space_from
from devrf.methods.base import RayTrainable
from devrf.methods.nerf.occupancy import OccupancyFrames, diagonal_step
from devrf.methods.nerf.placement import Placement
from devrf.methods.nerf.ray_view import RayView
from devrf.methods.nerf.samples import RaySamples
from devrf.rendering.output import RenderOutput
from devrf.scenes.scene import Scene


class PlacedModel(RayTrainable):
    """Networks in normalised space: the box that holds the scene, its longest edge being 2.

    Attributes:
        settings: sizes and sampling.
        placement: the maps from the fields' space (world units, NDC or contracted) and back.
        occupancy: where something may be at each frame, with ``sampling=occupancy``.
        clock: the frames' times.
    """

    settings_class: ClassVar[type[Any]]
    settings: Any

    def place(self) -> None:
        """Build what depends on the scene, as yet for one at rest in a cube around the origin."""
        self.occupancy = OccupancyFrames(1, (2, 2, 2))
        self.set_place(Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), WORLD, (0.0, 1.0))
        self.set_times((0.0, 1.0))

    def set_place(self, box: Box, space: Space, depths: tuple[float, float]) -> None:
        """Take the box, the fields' space, and the distances between which rays are sampled."""
        self.box, self.space, self.depth_limits = box, space, depths
        self.placement = Placement(box, space)

    def set_times(self, times: tuple[float, ...]) -> None:
        """Take the frames' times; a method with codes for them makes these here."""
        self.clock = FrameClock(times)

    def setup(self, scene: Scene) -> None:
        """Take the scene's bounds and times; carve the frames' occupancy from their alpha masks."""
        bounds, s = scene.bounds, self.settings
        box = bounds.whole
        self.set_place(box, scene.space, (bounds.near, bounds.far))
        self.set_times(scene.clock.times)
        if s.sampling == "occupancy":
            self.occupancy = OccupancyFrames.of(
                scene, box, s.occupancy_side, self.device, hull=s.hull, empty_from=s.empty_from
            )

    @property
    def has_hull(self) -> bool:
        """Whether the occupancy was carved from alpha masks."""
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
        near, far = config["limits"]
        model.set_place(Box.of(*config["box"]), space_from(config["space"]), (near, far))
        model.set_times(tuple(config["times"]))
        return model

    def on_iteration(self, step: int, total: int) -> None:
        """Look where the fields are empty."""
        share = self.settings.empty_from
        self.occupancy.learned.follow(step, total, share, self.box, self.opacity)

    @abstractmethod
    def opacity(self, points: Tensor, time: Tensor) -> Tensor:
        """Opacity (S,) of a step at points (S, 3) of the fields' space and times (S,)."""

    @abstractmethod
    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> RenderOutput:
        """What R rays in the fields' space see at ``time`` (R,).

        Args:
            rays: R rays.
            time: (R,) in [0, 1].
            background: (3,) or (R, 3) RGB.
            jitter: sample at random places, to learn from them.
        """

    def forward(self, batch: RayBatch) -> RenderOutput:
        """Render rays, each at its own time."""
        return self.render_rays(batch.rays, batch.time, batch.background, jitter=self.training)

    def march(self, rays: Rays, time: Tensor, *, jitter: bool) -> RaySamples:
        """Even steps where something may be at the frames around each ray's time."""
        before, after, _ = self.clock.between(time)
        step = diagonal_step(self.box, rays, self.settings.steps)
        return self.occupancy.march(
            rays, (before, after), self.box, self.depth_limits, step, jitter=jitter
        )

    def at(self, time: float, *, half: bool = False) -> RayView:
        """The scene at ``time``."""
        at_rest = self.clock.at(time).after == 0
        return RayView(self, time, self.device, at_rest=at_rest, half=half)
