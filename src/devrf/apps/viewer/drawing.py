"""The frames that the page shows, and their order of rendering."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.apps.keyframes import Keyframe, cameras_of
from devrf.apps.settings import ViewerSettings
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.metrics.geometric import SOLID
from devrf.pictures.images import depth_colors, flow_colors, to_bytes
from devrf.rendering.output import RenderedImage
from devrf.rendering.renderer import Renderer, points_at_depth
from devrf.rendering.view import MovingView

# Motion is shown as optical flow over STEP of the time, saturated at this share of the height.
STEP = 0.05
SATURATED = 0.02
# Seconds that a block of rays should take, and its fewest rays: a frame can be given up between
# blocks.
BLOCK_SECONDS = 0.08
MIN_RAYS = 512
# Nothing hides drawings in the scene where space is empty.
NOWHERE = 1e3
# A finer frame has at most FINER times the rows of the one before. A frame with more than NEARLY of
# all rows gets all at once.
FINER = 3
NEARLY = 0.75


@dataclass(frozen=True)
class Shot:
    """A frame to be rendered.

    Attributes:
        keyframe: the camera and the scene's time.
        aspect: width over height.
        channel: ``color``, ``depth``, ``opacity`` or ``motion``.
        part: ``all`` of the scene, or one of the drawing's parts alone.
        beside_rest: whether the rest state is shown beside, on the left, from so much farther that
            each half shows the whole width.
        crop: leave out what is outside this box (:class:`~devrf.rendering.renderer.CroppedRays`).
        with_depth: whether distances are asked for, to hide drawings behind the scene.
    """

    keyframe: Keyframe
    aspect: float
    channel: str = "color"
    part: str = "all"
    beside_rest: bool = False
    crop: Box | None = None
    with_depth: bool = False


@dataclass(frozen=True)
class Frame:
    """A frame (H, W, 3) uint8 on the host, and its duration.

    ``depth`` (H, W) is along the camera's axis in world units; None if not asked for.
    """

    pixels: Tensor
    depth: Tensor | None
    seconds: float


class Drawing:
    """Draws shots of a learned scene, and measures its speed.

    Attributes:
        renderer: renders the scene; it may be replaced while the scene is learned.
        parts: those of what moves and of what stays, by their names, where they are known.
        channels: the names of its channels.
        has_rest: whether it has a rest state beside others.
        at_rest: whether it looks the same at all times.
    """

    def __init__(
        self, renderer: Renderer, background: float, parts: Mapping[str, Renderer] | None = None
    ) -> None:
        """``background``: the grey level behind the scene."""
        self.renderer = renderer
        self.parts = parts or {}
        self._background = background
        end = renderer.at(1.0)
        self.at_rest = end.at_rest
        self.has_rest = renderer.at(0.0).at_rest and not end.at_rest
        motion = ("motion",) if isinstance(end, MovingView) and not end.at_rest else ()
        self.channels: tuple[str, ...] = ("color", "depth", "opacity", *motion)
        self._rays_per_second = 20_000.0
        self._overhead = 0.0

    def height_within(self, seconds: float, aspect: float, height: int) -> int:
        """The rows of a frame that takes about ``seconds``, at most ``height``."""
        budget = max(seconds - self._overhead, seconds / 4)
        rows = (budget * self._rays_per_second / aspect) ** 0.5
        return max(min(height, int(rows)), min(height, 16))

    def draw(self, shot: Shot, height: int) -> Iterator[Frame | None]:
        """Render a shot: None after each block of rays, then the frame."""
        began = time.perf_counter()
        current = shot.keyframe.time
        times = [0.0, current] if shot.beside_rest and self.has_rest else [current]
        tangent = len(times) * math.tan(math.radians(shot.keyframe.fov) / 2)
        keyframe = replace(shot.keyframe, fov=2 * math.degrees(math.atan(tangent)))
        parts = []
        depth = None
        renderer = self.parts.get(shot.part, self.renderer)
        for current in times:
            camera = cameras_of([keyframe], shot.aspect / len(times), height)
            camera = camera.to(renderer.device)
            started = time.perf_counter()
            with torch.no_grad():
                renderer.at(current)  # cached, or it takes a while
            self._overhead += 0.3 * (time.perf_counter() - started - self._overhead)
            started = time.perf_counter()
            blocks = []
            for block in self._blocks(renderer, shot, camera, current):
                blocks.append(block)
                yield None
            image = RenderedImage.joined([image for image, _ in blocks])
            vectors = torch.cat([flow for _, flow in blocks])
            parts.append(self._colored(shot.channel, camera, image, vectors))
            if shot.with_depth and len(times) == 1:
                depth = self._axial(camera, image)
            speed = camera.width * camera.height / max(time.perf_counter() - started, 1e-4)
            self._rays_per_second += 0.5 * (speed - self._rays_per_second)
        yield Frame(to_bytes(torch.cat(parts, dim=1)), depth, time.perf_counter() - began)

    @torch.no_grad()
    def _blocks(
        self, renderer: Renderer, shot: Shot, camera: Cameras, time: float
    ) -> Iterator[tuple[RenderedImage, Tensor]]:
        """Consecutive rows of pixels, with the motion (K, 2) where it is shown."""
        crop = shot.crop or renderer.reach(camera.positions[0])
        later = time + STEP if time + STEP <= 1 else time - STEP
        size = max(MIN_RAYS, int(BLOCK_SECONDS * self._rays_per_second))
        rows = math.ceil(size / camera.width)
        for first in range(0, camera.height, rows):
            band = camera.rows(first, min(first + rows, camera.height))
            image = renderer.view(band, 0, time, self._background, crop)
            vectors = torch.zeros_like(image.color[:, :2])
            if shot.channel == "motion":
                rays, pixels = band.image_rays(0), band.pixel_grid()
                flow = renderer.induced_flow(rays, pixels, band, time, later, crop)
                assert flow is not None  # the channel is offered where there is motion
                vectors = flow[0] * (1 if later > time else -1)
            yield image, vectors

    def _colored(
        self, channel: str, camera: Cameras, image: RenderedImage, vectors: Tensor
    ) -> Tensor:
        """The channel (H, W, 3) in [0, 1], on the host."""
        shape = (camera.height, camera.width)
        opacity = image.opacity.view(shape).cpu()
        if channel == "depth":
            model = self.renderer.model
            position = camera.positions[0].cpu()
            near, far = model.space.depth_range(model.box, model.depth_limits, position)
            return depth_colors(image.depth.view(shape).cpu(), opacity, near, far)
        if channel == "opacity":
            return opacity[..., None].expand(*shape, 3)
        if channel == "motion":
            full = SATURATED * camera.height
            return flow_colors(vectors.view(*shape, 2).cpu(), opacity > SOLID, full)
        return image.color.view(*shape, 3).clamp(0, 1).cpu()

    def _axial(self, camera: Cameras, image: RenderedImage) -> Tensor:
        """(H, W) world distances along the camera's axis; far away where nothing is."""
        space = self.renderer.model.space
        rays = camera.image_rays(0)
        _, depth = camera.project_into(0, points_at_depth(space, rays, image.depth))
        depth = torch.where(image.opacity > SOLID, depth, NOWHERE)
        return depth.view(camera.height, camera.width).cpu()


@dataclass
class _Request:
    """A browser's newest shot, and the rows last shown of it, or 0."""

    shot: Shot
    rows: int = 0


class RenderScheduler:
    """Renders the newest shot of each browser, coarse first; a finer frame ends when one moves.

    Browsers are served in turn. Shots may be asked for from any thread; frames are rendered by the
    one that calls :meth:`render_next`. A coarse frame is always finished: while a camera moves
    without pause it would never be seen otherwise.
    """

    def __init__(
        self,
        drawing: Drawing,
        show: Callable[[Hashable, Frame], None],
        settings: ViewerSettings,
        stop: threading.Event,
    ) -> None:
        """Begin with nothing to render.

        ``show`` takes each frame, with the browser's key. The settings say how many rows a full
        frame has, and about how long a first one takes. Once ``stop`` is set, the current frame is
        given up.
        """
        self.drawing = drawing
        self._stop = stop
        self._show = show
        self._height = settings.height
        self._move_seconds = settings.move_seconds
        self._requests: dict[Hashable, _Request] = {}  # the one served last is at the end
        self._change = threading.Condition()

    def ask(self, key: Hashable, shot: Shot) -> None:
        """Render ``shot`` for the browser ``key``, in place of its earlier one."""
        with self._change:
            self._requests[key] = _Request(shot)
            self._change.notify()

    def drop(self, key: Hashable) -> None:
        """Forget a browser."""
        with self._change:
            self._requests.pop(key, None)

    @property
    def watched(self) -> bool:
        """Whether anyone has asked for anything."""
        return bool(self._requests)

    def render_next(self, timeout: float) -> bool:
        """Show the most urgent frame, after at most ``timeout`` seconds; whether there was one."""
        with self._change:
            self._change.wait_for(self._most_urgent, timeout)
            urgent = self._most_urgent()
            if urgent is None:
                return False
            key, request = urgent
            self._requests[key] = self._requests.pop(key)
        full = self._height
        coarse = request.rows == 0
        aspect = request.shot.aspect
        rows = FINER * request.rows or self.drawing.height_within(self._move_seconds, aspect, full)
        rows = full if rows > NEARLY * full else rows
        try:
            for frame in self.drawing.draw(request.shot, rows):
                if frame is not None:
                    request.rows = rows
                    if key in self._requests:
                        self._show(key, frame)
                        return True
                elif self._stop.is_set() or (not coarse and self._overtaken(key, request)):
                    return False
        except Exception:
            request.rows = full  # it is not tried again: the other browsers' turn comes
            raise
        return False

    def _most_urgent(self) -> tuple[Hashable, _Request] | None:
        """The browser with the coarsest frame; among equals the one served longest ago."""
        waiting = [item for item in self._requests.items() if item[1].rows < self._height]
        return min(waiting, key=lambda item: item[1].rows, default=None)

    def _overtaken(self, key: Hashable, request: _Request) -> bool:
        """Whether the browser has moved on, or another waits for its first frame."""
        with self._change:
            return self._requests.get(key) is not request or any(
                not waiting.rows for waiting in self._requests.values()
            )
