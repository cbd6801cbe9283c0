"""What the page shows, and which of it is rendered next."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from devrf.apps.images import depth_colors, flow_colors, to_bytes
from devrf.apps.viewer.cameras import Pose
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.rendering.output import RenderedImage
from devrf.rendering.renderer import Renderer, in_chunks
from devrf.rendering.view import MovingView

# Motion is shown as optical flow over so much time, and saturated at this share of the height.
STEP, SATURATED = 0.05, 0.02
# A pixel is something that is seen from this opacity on.
SOLID = 0.5
# Seconds that a block of rays should take: between blocks a picture can be given up.
BLOCK_SECONDS, FEWEST = 0.08, 512
# In empty space nothing hides what is drawn into the scene.
NOWHERE = 1e3


@dataclass(frozen=True)
class Shot:
    """What a picture is to show.

    Attributes:
        pose: the camera.
        time: in [0, 1].
        channel: ``color``, ``depth``, ``opacity`` or ``motion``.
        beside_rest: whether the rest state is shown beside, on the left.
        crop: leave out what is outside this box (:class:`~devrf.rendering.renderer.CroppedRays`).
        with_depth: whether distances are asked for, to hide what is behind the scene.
    """

    pose: Pose
    time: float
    channel: str = "color"
    beside_rest: bool = False
    crop: Box | None = None
    with_depth: bool = False


@dataclass(frozen=True)
class Picture:
    """A finished picture.

    Attributes:
        pixels: (H, W, 3) uint8, on the host.
        depth: (H, W) distance along the camera's axis in world units; None if not asked for.
        seconds: what rendering it took.
    """

    pixels: Tensor
    depth: Tensor | None
    seconds: float


class Drawing:
    """Draws shots of a learned scene, and knows how fast that goes.

    Attributes:
        renderer: of the scene.
        channels: what can be shown of it.
        has_rest: whether it has a rest state beside others.
        at_rest: whether it looks the same at all times.
    """

    def __init__(self, renderer: Renderer, background: float) -> None:
        """``background``: the grey level behind the scene."""
        self.renderer, self._background = renderer, background
        end = renderer.at(1.0)
        self.at_rest = end.at_rest
        self.has_rest = renderer.at(0.0).at_rest and not end.at_rest
        motion = ("motion",) if isinstance(end, MovingView) and not end.at_rest else ()
        self.channels: tuple[str, ...] = ("color", "depth", "opacity", *motion)
        self._rays_per_second = 20_000.0
        self._overhead = 0.0

    def renew(self, renderer: Renderer) -> None:
        """Draw what the scene has become, by a renderer without views of before."""
        self.renderer = renderer

    def height_within(self, seconds: float, aspect: float, height: int) -> int:
        """The rows of a picture that takes about ``seconds``, at most ``height``."""
        left = max(seconds - self._overhead, seconds / 4)
        rows = (left * self._rays_per_second / aspect) ** 0.5
        return max(min(height, int(rows)), min(height, 16))

    def draw(self, shot: Shot, height: int) -> Iterator[Picture | None]:
        """Render a shot: None after each block of rays, then the picture."""
        began = time.perf_counter()
        moments = [0.0, shot.time] if shot.beside_rest and self.has_rest else [shot.time]
        parts, depths = [], []
        for moment in moments:
            aspect = shot.pose.aspect / len(moments)
            camera = replace(shot.pose, aspect=aspect).camera(height).to(self.renderer.device)
            started = time.perf_counter()
            with torch.no_grad():
                self.renderer.at(moment)  # cached, or it takes a while
            self._overhead += 0.3 * (time.perf_counter() - started - self._overhead)
            started, blocks = time.perf_counter(), []
            for block in self._blocks(shot, camera, moment):
                blocks.append(block)
                yield None
            image = RenderedImage.joined([image for image, _ in blocks])
            vectors = torch.cat([flow for _, flow in blocks])
            parts.append(self._colored(shot.channel, camera, image, vectors))
            if shot.with_depth and len(moments) == 1:
                depths.append(self._axial(camera, image))
            seconds = max(time.perf_counter() - started, 1e-4)
            speed = camera.width * camera.height / seconds
            self._rays_per_second += 0.5 * (speed - self._rays_per_second)
        yield Picture(
            to_bytes(torch.cat(parts, dim=1)),
            depths[0] if depths else None,
            time.perf_counter() - began,
        )

    @torch.no_grad()
    def _blocks(
        self, shot: Shot, camera: Cameras, moment: float
    ) -> Iterator[tuple[RenderedImage, Tensor]]:
        """Consecutive pixels in row-major order, with the motion (K, 2) where it is shown."""
        rays, pixels = camera.image_rays(0), camera.pixel_grid()
        crop = shot.crop or self.renderer.reach(camera.positions[0])
        size = max(FEWEST, int(BLOCK_SECONDS * self._rays_per_second))
        for first in range(0, len(rays), size):
            some = slice(first, first + size)
            image = self.renderer.picture(rays[some], moment, self._background, crop)
            wanted = shot.channel == "motion"
            vectors = self._motion(rays[some], pixels[some], camera, moment) if wanted else None
            yield image, torch.zeros_like(image.color[:, :2]) if vectors is None else vectors

    def _motion(self, rays: Rays, pixels: Tensor, camera: Cameras, moment: float) -> Tensor:
        """Optical flow (K, 2) in pixels over the next :data:`STEP`, at the end over the last."""
        view = self.renderer.at(moment)
        assert isinstance(view, MovingView)
        later = moment + STEP if moment + STEP <= 1 else moment - STEP
        own, flows, first = self.renderer.model.space.rays(rays), [], 0

        def flow(part: Rays) -> Tensor:
            nonlocal first
            mean, _ = view.induced_flow(part, pixels[first : first + len(part)], camera, later)
            first += len(part)
            return mean

        flows = in_chunks(flow, own, view.chunk)
        return torch.cat(flows) * (1 if later > moment else -1)

    def _colored(
        self, channel: str, camera: Cameras, image: RenderedImage, vectors: Tensor
    ) -> Tensor:
        """The channel (H, W, 3) in [0, 1], on the host."""
        shape = camera.height, camera.width
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
        own = space.rays(camera.image_rays(0))
        points = own.at(torch.arange(len(own), device=own.origins.device), image.depth)
        _, depth = camera.project_into(0, space.to_world(points))
        depth = torch.where(image.opacity > SOLID, depth, NOWHERE)
        return depth.view(camera.height, camera.width).cpu()


# A finer picture has at most so many times the rows of the one before.
FINER = 3
# Nearly full is made full at once.
NEARLY = 0.75


class Draws(Protocol):
    """What renders: a :class:`~devrf.apps.viewer.drawing.Drawing`."""

    def height_within(self, seconds: float, aspect: float, height: int) -> int:
        """The rows of a picture that takes about ``seconds``, at most ``height``."""
        ...

    def draw(self, shot: Shot, height: int) -> Iterator[Picture | None]:
        """Render a shot: None as often as it could be given up, then the picture."""
        ...


@dataclass
class _Asked:
    """What one viewer wants, and how far it has come.

    Attributes:
        shot: the newest one.
        number: counts the shots of all viewers, in order.
        rows: of the last picture of it that was shown; 0 before the first.
    """

    shot: Shot
    number: int
    rows: int = 0


class RenderScheduler:
    """Renders the newest shot of each viewer, coarse first; a finer picture ends when one moves.

    Shots may be asked for from any thread; pictures are rendered by the one that calls
    :meth:`render_next`. A coarse picture is always finished: while a camera moves without pause
    it would never be seen otherwise.
    """

    def __init__(
        self,
        drawing: Draws,
        show: Callable[[Hashable, Shot, Picture], None],
        *,
        height: int,
        move_seconds: float,
        stop: threading.Event | None = None,
    ) -> None:
        """Begin with nothing to render.

        Args:
            drawing: renders.
            show: takes each picture, with the viewer's key.
            height: rows of a full picture.
            move_seconds: about what a first picture may take.
            stop: once set, the present picture is given up, coarse or not.
        """
        self._stop = stop or threading.Event()
        self.drawing = drawing
        self._show, self._height, self._move_seconds = show, height, move_seconds
        self._asked: dict[Hashable, _Asked] = {}
        self._number = 0
        self._change = threading.Condition()

    def ask(self, key: Hashable, shot: Shot) -> None:
        """Render ``shot`` for the viewer ``key``, instead of what it asked for before."""
        with self._change:
            self._number += 1
            self._asked[key] = _Asked(shot, self._number)
            self._change.notify()

    def again(self) -> None:
        """Render what every viewer asked for anew: the scene has changed."""
        with self._change:
            for one in self._asked.values():
                one.rows = 0
            self._change.notify()

    def drop(self, key: Hashable) -> None:
        """Forget a viewer."""
        with self._change:
            self._asked.pop(key, None)

    @property
    def watched(self) -> bool:
        """Whether anyone has asked for anything."""
        return bool(self._asked)

    def render_next(self, timeout: float) -> bool:
        """Render the most urgent picture, and show it.

        Args:
            timeout: seconds to wait for something to render.

        Returns:
            Whether a picture was shown.
        """
        until = time.monotonic() + timeout
        with self._change:
            while (found := self._most_urgent()) is None:
                left = until - time.monotonic()
                if left <= 0 or not self._change.wait(left):
                    return False
        key, asked = found
        rows, coarse = self._next_rows(asked), asked.rows == 0
        for picture in self.drawing.draw(asked.shot, rows):
            if picture is None:
                if self._stop.is_set() or (not coarse and self._overtaken(key, asked)):
                    return False
                continue
            with self._change:
                present = key in self._asked
                asked.rows = rows
            if present:
                self._show(key, asked.shot, picture)
            return present
        return False

    def _most_urgent(self) -> tuple[Hashable, _Asked] | None:
        """The viewer whose picture is the coarsest; of several the one that has waited longest."""
        waiting = [(k, one) for k, one in self._asked.items() if one.rows < self._height]
        return min(waiting, key=lambda item: (item[1].rows, item[1].number), default=None)

    def _next_rows(self, asked: _Asked) -> int:
        if asked.rows:
            rows = asked.rows * FINER
        else:
            aspect = asked.shot.pose.aspect
            rows = self.drawing.height_within(self._move_seconds, aspect, self._height)
        return self._height if rows > NEARLY * self._height else rows

    def _overtaken(self, key: Hashable, asked: _Asked) -> bool:
        """Whether the viewer has moved on, or another waits for its first picture."""
        with self._change:
            return self._asked.get(key) is not asked or any(
                not one.rows for one in self._asked.values()
            )
