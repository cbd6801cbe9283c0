"""Renders a learned scene: images of any size, from anywhere, at any time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.geometry.space import WorldSpace
from devrf.rendering.chunks import in_chunks
from devrf.rendering.crop import CroppedRays
from devrf.rendering.rendered_image import RenderedImage
from devrf.rendering.view import Viewable


class Renderer:
    """Renders a learned scene of any method, without gradients.

    Views of the last few times are cached: changes of the model do not show at these times.

    Attributes:
        model: the scene.
        device: its device, on which images are rendered.
        at: time in [0, 1] → the :class:`~devrf.rendering.view.View` of that time, cached.
    """

    def __init__(self, model: Viewable, *, times: int = 4, half: bool = False) -> None:
        """Prepare to render.

        Args:
            model: a learned scene, not to be moved to another device afterwards.
            times: number of cached times.
            half: run networks in half precision, on a CUDA device only.
        """
        self.model = model
        self.device = model.device
        self.at = lru_cache(maxsize=times)(partial(model.at, half=half))

    @torch.no_grad()
    def picture(
        self, rays: Rays, time: float, background: float | Tensor, crop: Box | None = None
    ) -> RenderedImage:
        """Render R rays at ``time``.

        Args:
            rays: R rays in world space, on any device.
            time: in [0, 1].
            background: grey level, or RGB (3,).
            crop: what is outside this box is left out (:class:`~devrf.rendering.crop.CroppedRays`).
        """
        view = self.at(time)
        if not isinstance(background, Tensor):
            background = torch.full((3,), background, device=self.device)
        rays, space = rays.to(self.device), self.model.space
        cropped = crop and CroppedRays.of(rays, crop, space, self.model.depth_limits[0])
        own = cropped.rays if cropped else space.rays(rays)
        image = RenderedImage.joined(
            in_chunks(lambda part: view.render(part, background), own, view.chunk)
        )
        return cropped.completed(image, background) if cropped else image

    def view(
        self,
        cameras: Cameras,
        index: int,
        time: float,
        background: float | Tensor,
        crop: Box | None = None,
    ) -> RenderedImage:
        """All H·W pixels of camera ``index`` at ``time``, in row-major order."""
        rays = cameras[[index]].to(self.device).image_rays(0)
        return self.picture(rays, time, background, crop)

    def reach(self, position: Tensor) -> Box | None:
        """The scene's box, if a camera at ``position`` (3,) is so far off that it must be cropped.

        Nothing is sampled beyond the far limit, which suits the captured cameras: from further
        away rays have to begin at the box. None where the whole box is within the limit.
        """
        if not isinstance(self.model.space, WorldSpace):
            return None
        box, (_, far) = self.model.box, self.model.depth_limits
        low, high = box.corners(position)
        away = torch.maximum((position - low).abs(), (position - high).abs()).norm()
        return box if float(away) > far else None

    def stream(
        self, cameras: Cameras, times: Sequence[float], background: float | Tensor
    ) -> Iterator[RenderedImage]:
        """One image after another, each rendered when it is asked for.

        Args:
            cameras: N cameras.
            times: N times in [0, 1].
            background: as for :meth:`picture`.
        """
        cameras = cameras.to(self.device)
        for index, time in enumerate(times):
            yield self.view(cameras, index, time, background)
