"""Videos of a learned scene: their cameras and pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from devrf.apps.images import image_grid, scaled
from devrf.apps.still import sized, still
from devrf.errors import expect
from devrf.evaluation.held_out import background_value, truth_image
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer, points_at_depth
from devrf.scenes.scene import Background, Views

# Upper bound of the bytes of a pixel in a video: measured on images of 400 pixels and less.
PIXEL = 0.2
# H.264 has blocks of so many pixels.
MIN_HEIGHT = 16
# Fewer frames are no video.
MIN_FRAMES = 8


@dataclass(frozen=True)
class VideoSettings:
    """Settings of ``stage=render``; ``conf/video/default.yaml`` says what each does."""

    frames: int = 60
    fps: float = 20
    orbit_turns: float = 1.0
    orbit_elevation: float = 25.0
    height: int | None = None
    max_seconds: float | None = None
    half: bool = False
    path: str | None = None
    time: float = 0.5

    def __post_init__(self) -> None:
        height, max_seconds = self.height, self.max_seconds
        expect(0 <= self.time <= 1, "video.time", "0 to 1", self.time)
        high_enough = height is None or height >= MIN_HEIGHT
        expect(high_enough, "video.height", f"at least {MIN_HEIGHT}", height)
        expect(
            max_seconds is None or max_seconds > 0, "video.max_seconds", "more than 0", max_seconds
        )

    def sized(self, cameras: Cameras) -> Cameras:
        """Captured cameras with images of the video's size."""
        return sized(cameras, self.height)

    def within_limit(self, seconds: float) -> VideoSettings:
        """The settings for images that take ``seconds`` each: fewer frames if need be."""
        max_frames = self.frames if self.max_seconds is None else int(self.max_seconds / seconds)
        frames = min(self.frames, max(max_frames, MIN_FRAMES))
        return replace(self, frames=frames, fps=self.fps * frames / self.frames)


def orbit_pictures(
    renderer: Renderer,
    cameras: Cameras,
    background: float,
    times: Sequence[float] | None = None,
) -> Iterator[Tensor]:
    """Colour beside depth (H', W', 3) from each of N cameras.

    ``background`` is a grey level. ``times`` are N times in [0, 1] of cameras that may be
    anywhere; None: time runs from 0 to 1.
    """
    for index in range(len(cameras)):
        time = index / max(len(cameras) - 1, 1) if times is None else times[index]
        crop = None if times is None else renderer.reach(cameras.positions[index])
        color, depth = still(renderer, cameras, time, background, index, crop)
        yield image_grid([[color, depth]], [f"time {time:.2f}", "depth: near is bright"])


def held_out_pictures(
    renderer: Renderer,
    views: Views,
    images: Sequence[int],
    settings: VideoSettings,
    background: Background,
) -> Iterator[Tensor]:
    """Truth, rendering and depth (H', W', 3) side by side, while time runs from 0 to 1.

    ``images`` are those of the ``views`` to show, one a frame (:func:`held_out_images`).
    """
    cameras, behind = settings.sized(views.cameras), background_value(background)
    larger = ", enlarged" if cameras.height > views.height else ""
    for frame, image in enumerate(images):
        time = frame / max(len(images) - 1, 1)
        color, depth = still(renderer, cameras, time, behind, image)
        # Resized from its own size, not rendered: it shows what there is to compare with.
        truth = scaled(truth_image(views, image, background), cameras.height, cameras.width)
        headings = [
            f"truth at {float(views.times[image]):.2f} ({views.width}x{views.height}{larger})",
            f"rendered at time {time:.2f}",
            "depth: near is bright",
        ]
        yield image_grid([[truth, color, depth]], headings)


# The cameras of a video of some settings, around a scene or before it.
Ring = Callable[[VideoSettings], Cameras]
# Cameras and as many times in [0, 1].
Shots = tuple[Cameras, list[float]]


def orbit(cameras: Cameras, box: Box, settings: VideoSettings) -> Cameras:
    """Cameras on a circle around a box, looking at its middle.

    They have the captured ``cameras``' mean distance, focal length and up.
    """
    middle = torch.tensor(box.middle)
    radius = float((cameras.positions - middle).norm(dim=1).mean())
    up = normalize(cameras.camera_to_world[:, :, 1].mean(dim=0), dim=0)
    away = torch.eye(3)[int(up.abs().argmin())]
    east = normalize(torch.linalg.cross(away, up), dim=0)
    axes = torch.stack([east, torch.linalg.cross(up, east)])
    height = math.radians(settings.orbit_elevation)
    center = middle + radius * math.sin(height) * up
    return _ring(cameras, center, radius * math.cos(height) * axes, middle, up, settings)


def spiral(cameras: Cameras, focus: float, settings: VideoSettings) -> Cameras:
    """Cameras on a small ring among the captured ones, looking at a point before them.

    ``focus`` is the distance of that point, world units.
    """
    pose = cameras.camera_to_world.mean(dim=0)
    right, up, back = normalize(pose[:, :3], dim=0).unbind(dim=1)
    axes, middle = torch.stack([right, up]), pose[:, 3]
    offsets = (cameras.positions - middle) @ axes.T
    radii = 0.9 * offsets.abs().quantile(0.8, dim=0)
    return _ring(cameras, middle, radii[:, None] * axes, middle - focus * back, up, settings)


def bullet_time(ring: Ring, stop: float, settings: VideoSettings) -> Shots:
    """Once around the scene while its time stands still at ``stop``."""
    return ring(settings), [stop] * settings.frames


def time_freeze(ring: Ring, stop: float, settings: VideoSettings) -> Shots:
    """Time runs to ``stop`` and stands still while the camera goes round; then it runs on.

    Each takes a third of the frames.
    """
    third = settings.frames // 3
    around = settings.frames - 2 * third
    cameras = ring(replace(settings, frames=around))
    before, after = torch.linspace(0, stop, third + 1)[:-1], torch.linspace(stop, 1, third)
    times = [*before.tolist(), *[stop] * around, *after.tolist()]
    return cameras[[0] * third + list(range(around)) + [0] * third], times


def held_out_images(views: Views, frames: int) -> list[int]:
    """The held-out image for each of ``frames`` times, evenly spread over [0, 1].

    Of a capture with fixed cameras these are images of the first one. Images at rest follow one
    another.
    """
    first = (views.view == views.view[0]).nonzero()[:, 0]
    images = first if len(first) > 1 else torch.arange(len(views))
    times = views.times[images]
    if bool((times == times[0]).all()):
        times = torch.linspace(0, 1, len(images))
    wanted = torch.linspace(0, 1, frames)
    nearest = (times[None] - wanted[:, None]).abs().argmin(dim=1)
    return [int(image) for image in images[nearest]]


def _ring(
    cameras: Cameras,
    center: Tensor,
    axes: Tensor,
    target: Tensor,
    up: Tensor,
    settings: VideoSettings,
) -> Cameras:
    """Cameras on the ellipse about ``center`` with the half axes (2, 3), looking at ``target``."""
    angle = torch.arange(settings.frames) * (2 * math.pi * settings.orbit_turns / settings.frames)
    positions = center + torch.stack([angle.cos(), angle.sin()], dim=1) @ axes
    return Cameras.looking_at(
        positions,
        target.expand_as(positions),
        focal=float(cameras.focal.mean()),
        width=cameras.width,
        height=cameras.height,
        up=up,
    )


def focus_distance(renderer: Renderer, cameras: Cameras) -> float:
    """Median depth along the optical axis, world units, of what the first camera sees at rest."""
    cameras = cameras.to(renderer.device)
    rays = cameras.image_rays(0)
    image = renderer.picture(rays, 0.0, 1.0)
    solid = (image.opacity > 0.5).nonzero()[:, 0]
    if len(solid) == 0:
        return float(cameras.positions.norm(dim=1).mean()) + 1.0
    points = points_at_depth(renderer.model.space, rays[solid], image.depth[solid])
    _, depth = cameras.project_into(0, points)
    return float(depth.median())
