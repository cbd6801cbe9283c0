"""Renders a learned scene: images of any size, from anywhere, at any time, whole or cropped."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TypeVar

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.geometry.space import Space, WorldSpace
from devrf.rendering.output import RenderedImage
from devrf.rendering.view import MovingView, Viewable
from devrf.system.memory import free_cache, is_oom

log = logging.getLogger(__name__)

Part = TypeVar("Part")

# Smaller chunks would hardly need less memory.
MIN_CHUNK = 256


class Renderer:
    """Renders a learned scene of any method, without gradients, on the scene's device.

    Views of the last few times are cached: changes of the model do not show at these times.

    Attributes:
        at: time in [0, 1] → the :class:`~devrf.rendering.view.View` of that time, cached.
    """

    def __init__(self, model: Viewable, *, times: int = 4, half: bool = False) -> None:
        """Prepare to render a scene, which is not to be moved to another device afterwards.

        ``times`` are cached; ``half`` runs networks in half precision, on a CUDA device only.
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
            crop: what is outside this box is left out (:class:`CroppedRays`).
        """
        view = self.at(time)
        if not isinstance(background, Tensor):
            background = torch.full((3,), background, device=self.device)
        rays, space = rays.to(self.device), self.model.space
        cropped = crop and CroppedRays.of(rays, crop, space, self.model.depth_limits[0])
        field_rays = cropped.rays if cropped else space.rays(rays)
        image = RenderedImage.joined(
            in_chunks(lambda part: view.render(part, background), field_rays, view.chunk)
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

    @torch.no_grad()
    def induced_flow(
        self, rays: Rays, pixels: Tensor, camera: Cameras, time: float, other: float
    ) -> tuple[Tensor, Tensor] | None:
        """As :meth:`~devrf.rendering.view.MovingView.induced_flow`, of world rays, in chunks.

        The flow at ``time`` from or to the time ``other``. None if views have no motion.
        """
        view = self.at(time)
        if not isinstance(view, MovingView):
            return None
        rays, pixels, camera = rays.to(self.device), pixels.to(self.device), camera.to(self.device)
        done = 0

        def flow(part: Rays) -> tuple[Tensor, Tensor]:
            nonlocal done
            mean_and_mass = view.induced_flow(part, pixels[done : done + len(part)], camera, other)
            done += len(part)
            return mean_and_mass

        parts = in_chunks(flow, self.model.space.rays(rays), view.chunk)
        return torch.cat([mean for mean, _ in parts]), torch.cat([mass for _, mass in parts])

    def reach(self, position: Tensor) -> Box | None:
        """The scene's box, if a camera at ``position`` (3,) is so far off that it must be cropped.

        Nothing is sampled beyond the far limit: from further away rays have to begin at the box.
        """
        if not isinstance(self.model.space, WorldSpace):
            return None
        box, (_, far) = self.model.box, self.model.depth_limits
        low, high = box.corners(position)
        away = torch.maximum((position - low).abs(), (position - high).abs()).norm()
        return box if float(away) > far else None


def points_at_depth(space: Space, rays: Rays, depth: Tensor) -> Tensor:
    """World points (R, 3) at ``depth`` (R,), in the fields' space, along R world rays."""
    field_rays = space.rays(rays)
    return space.to_world(field_rays.at(torch.arange(len(field_rays), device=depth.device), depth))


def in_chunks(render: Callable[[Rays], Part], rays: Rays, chunk: int) -> list[Part]:
    """``render(rays[k:l])`` for consecutive chunks of R ``rays``, in order; at least one.

    When memory runs out, this and later chunks are halved, down to ``MIN_CHUNK`` rays.
    """
    parts: list[Part] = []
    first, chunk = 0, min(chunk, max(len(rays), 1))
    while first < len(rays) or not parts:
        try:
            parts.append(render(rays[first : first + chunk]))
            first += chunk
            continue
        except (RuntimeError, MemoryError) as error:
            if chunk // 2 < MIN_CHUNK or not is_oom(error):
                raise
        # Outside the handler, where the error's traceback no longer holds tensors.
        free_cache(rays.origins.device)
        chunk //= 2
        log.warning("out of memory: pictures are rendered %d rays at a time", chunk)
    return parts


@dataclass(frozen=True)
class CroppedRays:
    """Rays that begin where they enter a box.

    What is before the box is cut off exactly. What is behind it is left out pixel by pixel: where
    the mean depth lies behind the box, the background is seen.

    Attributes:
        rays: the K of R rays that meet the box, in the fields' space, from where they enter it.
        hit: (R,) bool, which they are.
        skipped: (K,) the distance from the origin of each ray to where it begins now.
        length: (K,) the distance from there to where it leaves the box.
    """

    rays: Rays
    hit: Tensor
    skipped: Tensor
    length: Tensor

    @staticmethod
    def of(rays: Rays, box: Box, space: Space, near: float) -> CroppedRays:
        """Crop R world rays to a box in the fields' space ``space``.

        Of a contracted scene the box is in its inner box, where that space is the world. ``near``
        is the distance before which a view samples nothing.
        """
        lines = space.rays(rays) if space.is_linear else rays
        entry, leave = lines.crossing(*box.corners(lines.origins), 0.0, math.inf)
        hit = entry < leave
        lines, entry, leave = lines[hit], entry[hit], leave[hit]
        skipped = (entry - near).clamp(min=0)
        lines = replace(lines, origins=lines.origins + skipped[:, None] * lines.directions)
        if not space.is_linear:
            lines = space.rays(lines)
        return CroppedRays(lines, hit, skipped, leave - skipped)

    def completed(self, image: RenderedImage, background: Tensor) -> RenderedImage:
        """The image of all R rays from that of the K, with the background (3,) elsewhere."""
        inside = image.depth <= self.length
        visible = self.hit.clone()
        visible[self.hit] = inside
        color = background.expand(len(self.hit), 3).clone()
        color[visible] = image.color[inside]
        depth, opacity = (torch.zeros_like(self.hit, dtype=color.dtype) for _ in range(2))
        depth[visible] = (image.depth + self.skipped)[inside]
        opacity[visible] = image.opacity[inside]
        return RenderedImage(color, depth, opacity)
