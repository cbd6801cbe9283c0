"""A learned scene to be looked at: pictures of any size, from anywhere, at any time, quickly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.methods.devrf.image_lists import ListRenderer
from devrf.methods.devrf.model import SceneModel, occupancy_points, occupancy_through
from devrf.methods.devrf.volume_rendering import Warp, render
from devrf.methods.devrf.voxel_grid import resample
from devrf.ops.corners import shape_of
from devrf.ops.dispatch import triton_runs
from devrf.rendering.chunks import in_chunks
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.rendered_image import RenderedImage

# Rays at once: on a CPU what its caches hold, on a GPU what keeps it busy and fits.
ON_CPU, ON_GPU, IN_LISTS = 8192, 2**15, 2**18


@dataclass(frozen=True)
class Ready:
    """A time of a scene, ready to be looked at from anywhere.

    Attributes:
        occupancy: where something is then.
        displacement: (X, Y, Z, 3) from there to canonical space, over the fields' box; None at
            rest.
        warp: the same as a map of points (M, 3); None at rest.
    """

    occupancy: Occupancy
    displacement: Tensor | None = None
    warp: Warp | None = None


class Renderer:
    """Shows a scene that is learned, without gradients.

    It shows what :meth:`SceneModel.picture` shows, and keeps what it has found out about the
    times that it was asked for last. What is learned afterwards is not seen at these times.

    Attributes:
        model: the scene.
        device: where it is, and where pictures are made.
    """

    def __init__(self, model: SceneModel, *, times: int = 4, half: bool = False) -> None:
        """Get ready.

        Args:
            model: a learned scene; it should not be moved to another device afterwards.
            times: how many times to keep ready.
            half: let the colour network work in half precision, on a CUDA device only.
        """
        self.model = model
        self.device = model.canonical.density.values.device
        self.ready = lru_cache(maxsize=times)(self._prepared)
        self._lists = ListRenderer(model.canonical, model.settings, half=half)

    @torch.no_grad()
    def _prepared(self, time: float) -> Ready:
        """Make ``time`` ready; ``ready`` looks among what is kept first."""
        model, motion = self.model, self.model.deformation
        if motion is None or motion.clock.at(time).after == 0:
            return Ready(model.occupancy)
        displacement = motion.blended(motion.to_canonical, time)
        # At the points of a grid over the same box, looking up is resampling: several times faster.
        points = occupancy_points(model)
        moved = points + resample(displacement, shape_of(points))
        warp = GridWarp((displacement,), motion.box)
        return Ready(occupancy_through(model, moved), displacement, warp)

    @torch.no_grad()
    def picture(self, rays: Rays, time: float, background: float | Tensor) -> RenderedImage:
        """What rays see at ``time``.

        Args:
            rays: R rays in world space, on any device.
            time: in [0, 1].
            background: grey level, or RGB (3,).
        """
        rays, model, ready = rays.to(self.device), self.model, self.ready(time)
        if not isinstance(background, Tensor):
            background = torch.full((3,), background, device=self.device)
        rays = model.space.rays(rays)
        if triton_runs(model.canonical.density.values):
            size = IN_LISTS

            def see(part: Rays) -> RenderedImage:
                displacement = ready.displacement
                return self._lists.picture(part, ready.occupancy, displacement, background)
        else:
            size = ON_GPU if self.device.type == "cuda" else ON_CPU

            def see(part: Rays) -> RenderedImage:
                occupancy, settings = ready.occupancy, model.settings
                return RenderedImage.of(
                    render(part, model.canonical, occupancy, settings, background, ready.warp)
                )

        return RenderedImage.joined(in_chunks(see, rays, size))

    def view(
        self, cameras: Cameras, index: int, time: float, background: float | Tensor
    ) -> RenderedImage:
        """All H·W pixels of camera ``index`` at ``time``, in row-major order."""
        rays = cameras[[index]].to(self.device).image_rays(0)
        return self.picture(rays, time, background)

    def stream(
        self, cameras: Cameras, times: Sequence[float], background: float | Tensor
    ) -> Iterator[RenderedImage]:
        """One picture after another, each made when it is asked for.

        Args:
            cameras: N cameras.
            times: N times in [0, 1].
            background: as for :meth:`picture`.
        """
        cameras = cameras.to(self.device)
        for index, time in enumerate(times):
            yield self.view(cameras, index, time, background)
