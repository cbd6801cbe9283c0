"""A scene on one page: cameras and boxes, sample images, and optical flow as colours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from devrf.artifacts.colors import flow_colors, flow_wheel, to_bytes
from devrf.artifacts.inspection.camera_plot import draw_cameras, first_images
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Scene, Views
from devrf.system.files import atomic_write

# Sizes in inches, of which each is 100 pixels.
WIDTH, TITLE, CAMERAS, HEADING, CAPTION = 16.0, 0.6, 6.6, 0.5, 0.35
# No image is higher, so that portrait images do not fill a page each.
TALLEST = 2.8
COLUMNS = 6
MOST_VIEWS = 4
# Longest name below an image, in characters.
LONGEST_NAME = 28
STYLE: dict[Any, Any] = {
    "font.size": 13,
    "text.color": "0.15",
    "text.parse_math": False,  # a name may hold $
    "axes.labelcolor": "0.3",
    "axes.edgecolor": "0.85",
    "axes3d.xaxis.panecolor": "0.98",
    "axes3d.yaxis.panecolor": "0.98",
    "axes3d.zaxis.panecolor": "0.95",
    "grid.color": "0.85",
}


@dataclass(frozen=True)
class Tile:
    """An image (H, W, 3) uint8 with its label."""

    image: np.ndarray
    label: str


@dataclass(frozen=True)
class Section:
    """Rows of tiles below a heading; None leaves a place empty."""

    heading: str
    rows: list[list[Tile | None]]
    height: float


def write_inspection_picture(path: Path, scene: Scene) -> None:
    """Write the page of a scene as a PNG, 1600 pixels wide and as high as it needs to be."""
    with atomic_write(path) as partial:
        inspection_figure(scene).savefig(partial, format="png")


def inspection_figure(scene: Scene) -> Figure:
    """The page of a scene: 16 inches wide, 100 pixels each."""
    sections = [_static_section(scene.static.train), *_dynamic_sections(scene.dynamic.train)]
    heights = [
        CAMERAS,
        *(HEADING + len(section.rows) * (section.height + CAPTION) for section in sections),
    ]
    with matplotlib.rc_context(STYLE):
        figure = Figure((WIDTH, TITLE + sum(heights)), dpi=100, layout="constrained")
        figure.suptitle(f"{scene.name}, {scene.kind}-facing", fontsize=24, fontweight="bold")
        parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
        draw_cameras(parts[0], scene)
        for part, section in zip(parts[1:], sections, strict=True):
            part.suptitle(section.heading, fontsize=17, x=0.005, ha="left")
            places = part.subplots(len(section.rows), COLUMNS, squeeze=False)
            for row, axes in zip(section.rows, places, strict=True):
                for k, place in enumerate(axes):
                    _draw_tile(place, row[k] if k < len(row) else None)
    return figure


def _draw_tile(axes: Axes, tile: Tile | None) -> None:
    if tile is None:
        axes.set_axis_off()
        return
    axes.imshow(tile.image)
    axes.set(xticks=[], yticks=[], xlabel=tile.label)


def _static_section(views: Views) -> Section:
    tiles = [Tile(shown(views, k), _short(views.names[k])) for k in evenly(len(views), COLUMNS)]
    heading = f"At rest: {_count(len(views), 'static view')} to learn from"
    return Section(heading, [[*tiles]], _tile_height(views))


def _dynamic_sections(views: Views) -> list[Section]:
    """Sample images of the dynamic views, and below the flow of the same images."""
    rows, height = sample_images(views), _tile_height(views)
    labels = {
        k: f"view {int(views.view[k])}, time {float(views.times[k]):.2f}"
        for row in rows
        for k in row
    }
    images = [[Tile(shown(views, k), labels[k]) for k in row] for row in rows]
    sections = [Section(f"In motion: {_motion(views)}", [[*row] for row in images], height)]
    if views.flow is None:
        return sections
    longest, flowing = flow_scale(views), {image for image, _ in frame_pairs(views)}
    tiles: list[list[Tile | None]] = [
        [Tile(_flow_image(views, k, longest), labels[k]) if k in flowing else None for k in row]
        for row in rows
    ]
    # The first image of a view has no frame before it.
    wheel = to_bytes(flow_wheel(300)).numpy()
    tiles[0][0] = Tile(wheel, f"rim: {longest:.3g} px or more")
    heading = (
        "Optical flow: where each pixel was one frame earlier; the wheel shows the direction, "
        "grey is unknown"
    )
    return [*sections, Section(heading, tiles, height)]


def sample_images(views: Views) -> list[list[int]]:
    """Positions of images to show: a row for each of some fixed views, at some times.

    Images of a moving camera follow one another in up to two rows.
    """
    order = sorted(range(len(views)), key=lambda k: (float(views.times[k]), k))
    numbers = list(first_images(views))
    if len(numbers) == len(views):
        some = [order[k] for k in evenly(len(order), 2 * COLUMNS)]
        return [some[k : k + COLUMNS] for k in range(0, len(some), COLUMNS)]
    rows = []
    for k in evenly(len(numbers), MOST_VIEWS):
        own = [image for image in order if int(views.view[image]) == numbers[k]]
        rows.append([own[j] for j in evenly(len(own), COLUMNS)])
    return rows


def evenly(count: int, most: int) -> list[int]:
    """At most ``most`` of the positions 0 … count − 1, evenly spread, both ends among them."""
    return [round(k) for k in np.linspace(0, count - 1, min(count, most))]


def flow_scale(views: Views) -> float:
    """The length in pixels that is shown saturated: 99 % of the valid flow is shorter."""
    assert views.flow is not None
    lengths = torch.cat(
        [
            vectors[valid].norm(dim=-1)[::7]  # a sample of the pixels is enough
            for vectors, valid in zip(views.flow.vectors, views.flow.valid, strict=True)
        ]
    )
    lengths = lengths[torch.isfinite(lengths)]
    return max(float(np.quantile(lengths.numpy(), 0.99)), 1e-3) if len(lengths) else 1.0


def shown(views: Views, image: int) -> np.ndarray:
    """An image as RGB (H', W', 3); what masks or alpha leave out is chequered."""
    picture = np.asarray(_smaller(visible_pixels(views, image).cpu().numpy()))
    if picture.shape[2] == 3:
        return picture
    height, width = picture.shape[:2]
    y, x = np.indices((height, width)) // max(1, round(width / 24))
    squares = np.where((x + y) % 2, 232.0, 255.0)[..., None]
    alpha = picture[..., 3:] / 255
    blended: np.ndarray = (squares + alpha * (picture[..., :3] - squares)).astype(np.uint8)
    return blended


def visible_pixels(views: Views, image: int) -> Tensor:
    """An image's pixels (H, W, 3 or 4); those that do not count are transparent."""
    pixels = views.pixels[image]
    if views.valid_mask is None:
        return pixels
    alpha = views.valid_mask[image].to(torch.uint8)[..., None] * 255
    alpha = torch.minimum(alpha, pixels[..., 3:]) if views.has_alpha else alpha
    return torch.cat([pixels[..., :3], alpha], dim=-1)


def _flow_image(views: Views, image: int, longest: float) -> np.ndarray:
    assert views.flow is not None
    colors = flow_colors(views.flow.vectors[image], views.flow.valid[image], longest)
    return np.asarray(_smaller(to_bytes(colors).numpy()))


def _smaller(pixels: np.ndarray) -> Image.Image:
    """Reduced by a whole factor to little more than is shown: a page of full images is large."""
    image = Image.fromarray(np.ascontiguousarray(pixels))
    return image.reduce(max(1, image.width // 300))


def _tile_height(views: Views) -> float:
    return min(TALLEST, (WIDTH / COLUMNS - 0.15) * views.height / views.width)


def _motion(views: Views) -> str:
    numbers, times = len(set(views.view.tolist())), len(set(views.times.tolist()))
    if numbers == len(views):
        return f"a moving camera, {_count(len(views), 'image')}"
    return f"{_count(numbers, 'fixed view')} to learn from, {_count(times, 'time')}"


def _count(number: int, word: str) -> str:
    return f"{number} {word}" + "s" * (number != 1)


def _short(name: str) -> str:
    """The end of a file's name."""
    name = Path(name).name
    return name if len(name) <= LONGEST_NAME else f"…{name[1 - LONGEST_NAME :]}"
