"""Videos of a learned scene, colour beside depth, while time runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from devrf.apps.colors import to_bytes
from devrf.apps.grid import image_grid, scaled
from devrf.apps.still import sized, still
from devrf.apps.video_file import write_pictures
from devrf.errors import DevrfError
from devrf.evaluation.held_out import background_value, truth_image
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Background, Views

# Upper bound of the bytes of a pixel in a video: measured on images of 400 pixels and less.
PIXEL = 0.2
# H.264 has blocks of so many pixels.
SMALLEST = 16
# Fewer frames are no video.
FEWEST = 8


@dataclass(frozen=True)
class FilmSettings:
    """The videos that ``stage=render`` writes.

    Attributes:
        frames: images of each video, evenly spread over [0, 1]: times between the captured
            frames are rendered like any other.
        fps: images a second.
        orbit_turns: how often the orbit goes round while time runs once.
        orbit_elevation: degrees above the horizon.
        height: of the rendered images in pixels; None for the captured images' height, but at
            least 400.
        max_seconds: what rendering a video may take; where it would take longer, fewer frames
            are rendered, over the same duration. None: no limit.
        half: whether the colour network works in half precision, on a CUDA device only.
        path: a file of keyframes (:mod:`~devrf.apps.path_files`), ``bullet_time`` or
            ``time_freeze``: the one video to render; None: the held-out view and the orbit.
        time: in [0, 1], when the last two of them stop.
    """

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
        if not 0 <= self.time <= 1:
            raise DevrfError(f"video.time: expected 0 to 1, not {self.time}")
        if self.height is not None and self.height < SMALLEST:
            raise DevrfError(f"video.height: expected at least {SMALLEST}, not {self.height}")
        if self.max_seconds is not None and not self.max_seconds > 0:
            raise DevrfError(f"video.max_seconds: expected more than 0, not {self.max_seconds}")

    def sized(self, cameras: Cameras) -> Cameras:
        """Captured cameras with images of the video's size."""
        return sized(cameras, self.height)

    def within_limit(self, seconds: float) -> FilmSettings:
        """The settings for images that take ``seconds`` each: fewer frames if need be."""
        most = self.frames if self.max_seconds is None else int(self.max_seconds / seconds)
        frames = min(self.frames, max(most, FEWEST))
        return replace(self, frames=frames, fps=self.fps * frames / self.frames)


def orbit_pictures(
    renderer: Renderer,
    cameras: Cameras,
    background: float,
    times: Sequence[float] | None = None,
) -> Iterator[Tensor]:
    """Colour beside depth (H', W', 3) from each of N cameras.

    Args:
        renderer: of the learned scene.
        cameras: N cameras.
        background: grey level.
        times: N times in [0, 1], of cameras that may be anywhere; None: time runs from 0 to 1.
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
    film: FilmSettings,
    background: Background,
) -> Iterator[Tensor]:
    """Truth, rendering and depth (H', W', 3) side by side, while time runs from 0 to 1.

    Args:
        renderer: of the learned scene.
        views: the held-out views, on the host.
        images: for each frame the held-out image to show, whose camera is used
            (:func:`~devrf.apps.camera_paths.held_out_images`).
        film: the images' height.
        background: what is behind the alpha mask.
    """
    cameras, behind = film.sized(views.cameras), background_value(background)
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


def write_video(path: Path, images: Iterator[Tensor], fps: float) -> None:
    """Write images (H, W, 3) in [0, 1] of one size as an mp4 (H.264), ``fps`` a second."""
    write_pictures(path, (to_bytes(image).numpy() for image in images), fps)


def film_bytes(film: FilmSettings, cameras: Cameras) -> int:
    """Upper estimate of the size in bytes of both videos, for the captured cameras.

    Two images a frame in one, three in the other, and labels above them.
    """
    shown = film.sized(cameras)
    return round(film.frames * 5 * (1.1 * shown.height) * shown.width * PIXEL)
