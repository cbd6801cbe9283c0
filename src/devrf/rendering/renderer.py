"""Renders a learned scene: images of any size, from anywhere, at any time, whole or cropped."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain
from typing import TypeVar

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras, pixel_positions
from devrf.geometry.rays import Rays
from devrf.geometry.space import Space, WorldSpace
from devrf.rendering.output import RenderedImage
from devrf.rendering.renderable import Renderable
from devrf.rendering.view import ImageView, MovingView
from devrf.system.memory import free_cache, is_oom

log = logging.getLogger(__name__)

Part = TypeVar("Part")

# Smaller chunks would hardly need less memory, and would take as long.
MIN_CHUNK = 256
# Chunks that are rendered at once on a CPU: each takes memory.
MOST_WORKERS = 8


class Renderer:
    """Renders a learned scene of any method, without gradients, on the scene's device.

    Views of the last few times are cached: a change of the model does not show at these times.

    Attributes:
        smooth: whether a pixel may be the mean of four rays; else it has one.
        at: time in [0, 1] → the view of that time (:mod:`devrf.rendering.view`), cached.
    """

    def __init__(self, model: Renderable, *, times: int = 4, smooth: bool = True) -> None:
        """Prepare to render a scene, which is not to be moved to another device afterwards.

        So many ``times`` are cached.
        """
        self.model = model
        self.device = model.device
        self.smooth = smooth
        self.at = lru_cache(maxsize=times)(model.at)

    @torch.no_grad()
    def picture(
        self, rays: Rays, time: float, background: float | Tensor, crop: Box | None = None
    ) -> RenderedImage:
        """Render R rays at ``time``; of a method that renders rays.

        Args:
            rays: R rays in world space, on any device.
            time: in [0, 1].
            background: grey level, or RGB (3,).
            crop: only the part of the scene in this box is rendered (:class:`CroppedRays`).
        """
        view, background = self.at(time), self._color(background)
        assert not isinstance(view, ImageView)
        field_rays, cropped = self._field_rays(rays, crop)

        def rendered(part: slice) -> RenderedImage:
            return view.render(field_rays[part], background)

        image = RenderedImage.joined(in_chunks(rendered, len(field_rays), view.chunk, self.device))
        return cropped.completed(image, background) if cropped else image

    @torch.no_grad()
    def view(
        self,
        cameras: Cameras,
        index: int,
        time: float,
        background: float | Tensor,
        crop: Box | None = None,
    ) -> RenderedImage:
        """All H·W pixels of camera ``index`` at ``time``, in row-major order.

        Where pixels have four rays, they are the means of four pictures, each by rays through
        another quarter of them (docs/method.md#rays-of-a-pixel).
        """
        camera = cameras[[index]].to(self.device)
        view = self.at(time)
        if isinstance(view, ImageView):
            return view.image(camera, self._color(background), crop)
        per_pixel = self.model.rays_per_pixel(camera) if self.smooth else 1
        first = torch.zeros(1, dtype=torch.int64, device=self.device)
        middles = pixel_positions(first, width=1, per_pixel=per_pixel)
        pictures = [
            self.picture(camera.shifted(shift).image_rays(0), time, background, crop)
            for shift in middles - 0.5
        ]
        return RenderedImage.mean(pictures)

    def _field_rays(self, rays: Rays, crop: Box | None) -> tuple[Rays, CroppedRays | None]:
        """World rays in the fields' space; only those that meet the ``crop``, if there is one."""
        rays, space = rays.to(self.device), self.model.space
        if crop is None:
            return space.rays(rays), None
        cropped = CroppedRays.of(rays, crop, space, self.model.depth_limits[0])
        return cropped.rays, cropped

    def _color(self, background: float | Tensor) -> Tensor:
        """The RGB (3,) of a background."""
        if isinstance(background, Tensor):
            return background
        return torch.full((3,), background, device=self.device)

    @torch.no_grad()
    def induced_flow(
        self,
        rays: Rays,
        pixels: Tensor,
        camera: Cameras,
        time: float,
        other: float,
        crop: Box | None = None,
    ) -> tuple[Tensor, Tensor] | None:
        """As :meth:`~devrf.rendering.view.MovingView.induced_flow`, of world rays, in chunks.

        The flow at ``time`` from or to the time ``other``. What lies before a ``crop`` is left out;
        rays that miss it have none. None if views have no motion.
        """
        view = self.at(time)
        if not isinstance(view, MovingView):
            return None
        pixels, camera = pixels.to(self.device), camera.to(self.device)
        field_rays, cropped = self._field_rays(rays, crop)
        hit = torch.ones_like(pixels[:, 0], dtype=torch.bool) if cropped is None else cropped.hit
        vectors, masses = torch.zeros_like(pixels), torch.zeros_like(pixels[:, 0])
        pixels = pixels[hit]

        def flow(part: slice) -> tuple[Tensor, Tensor]:
            return view.induced_flow(field_rays[part], pixels[part], camera, other)

        parts = in_chunks(flow, len(field_rays), view.chunk, self.device)
        vectors[hit] = torch.cat([mean for mean, _ in parts])
        masses[hit] = torch.cat([mass for _, mass in parts])
        return vectors, masses

    def reach(self, position: Tensor) -> Box | None:
        """The scene's box, if a camera at ``position`` (3,) is so far off that it must be cropped.

        Nothing is sampled beyond the far limit: rays from further away have to begin at the box.
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


def in_chunks(
    render: Callable[[slice], Part], rays: int, chunk: int, device: torch.device
) -> list[Part]:
    """``render(slice(k, l))`` for consecutive chunks of R ``rays``, in order; at least one.

    A CPU renders several at once, each on its share of the cores: one chunk's operations are too
    small for all of them. Chunks are smaller there, so that all workers get equally many, of one
    size. When memory runs out, this and later chunks are halved, down to ``MIN_CHUNK``.
    """
    most = chunk

    def parts(first: int, last: int) -> list[Part]:
        nonlocal most
        size = last - first
        if size <= most:
            try:
                return [render(slice(first, last))]
            except (RuntimeError, MemoryError) as error:
                if size // 2 < MIN_CHUNK or not is_oom(error):
                    raise
            # Outside the handler, where the error's traceback no longer holds tensors.
            free_cache(device)
            most = min(most, size // 2)
            log.warning("out of memory: pictures are rendered %d rays at a time", most)
        return parts(first, first + size // 2) + parts(first + size // 2, last)

    threads = torch.get_num_threads()
    workers = min(threads, MOST_WORKERS) if device.type == "cpu" else 1
    if workers > 1:
        rounds = max(math.ceil(rays / (chunk * workers)), 1)
        chunk = min(chunk, max(math.ceil(rays / (rounds * workers)), MIN_CHUNK))
    firsts = range(0, max(rays, 1), chunk)
    lasts = [min(first + chunk, rays) for first in firsts]
    workers = min(workers, len(firsts))
    if workers == 1:
        return list(chain.from_iterable(map(parts, firsts, lasts)))
    share = partial(torch.set_num_threads, threads // workers)
    try:
        with ThreadPoolExecutor(workers, initializer=share) as pool:
            return list(chain.from_iterable(pool.map(parts, firsts, lasts)))
    finally:
        torch.set_num_threads(threads)  # threads that start later take the last that was set


@dataclass(frozen=True)
class CroppedRays:
    """Rays that begin where they enter a box.

    The part before the box is cut off exactly, the part behind it pixel by pixel: pixels whose mean
    depth lies behind the box show the background.

    Attributes:
        rays: the K of R rays that meet the box, in the fields' space, from where they enter it.
        hit: (R,) bool, the mask of these rays.
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

        The box of a contracted scene lies in the inner box, where that space is the world. ``near``
        is the distance of a view's first sample.
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
