"""A scene on one page: cameras and boxes, sample images, and optical flow as colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from devrf.artifacts.colors import flow_colors, flow_wheel, to_bytes
from devrf.artifacts.images import evenly, short_name
from devrf.artifacts.inspection.camera_plot import draw_cameras, first_images
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import OpticalFlow, Scene, Views
from devrf.system.files import atomic_write

# Sizes in inches, of which each is 100 pixels.
WIDTH, TITLE, CAMERAS, HEADING, CAPTION, GAP = 16.0, 0.7, 6.6, 0.6, 0.4, 0.15
# No image is higher, so that portrait images do not fill a page each.
TALLEST = 2.8
COLUMNS = 6
MOST_VIEWS = 4
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
    "xtick.labelsize": 11,
    "ytick.labelsize": 11,
}


Rectangle = tuple[float, float, float, float]
# An image (H, W, 3) uint8 and its label.
Tile = tuple[np.ndarray, str]


@dataclass(frozen=True)
class Section:
    """Rows of tiles below a heading; None leaves a place empty."""

    heading: str
    rows: Sequence[Sequence[Tile | None]]
    tile_height: float

    @property
    def height(self) -> float:
        """Of the whole section, in inches."""
        return HEADING + len(self.rows) * (self.tile_height + CAPTION)


def write_inspection_picture(path: Path, scene: Scene) -> None:
    """Write the page of a scene as a PNG, 1600 pixels wide and as high as it needs to be."""
    with atomic_write(path) as partial:
        inspection_figure(scene).savefig(partial, format="png", dpi="figure")


def inspection_figure(scene: Scene) -> Figure:
    """The page of a scene: 16 inches wide, 100 pixels each."""
    sections = [_static_section(scene.static.train), *_dynamic_sections(scene.dynamic.train)]
    height = TITLE + CAMERAS + sum(section.height for section in sections)
    with matplotlib.rc_context(STYLE):
        figure = Figure((WIDTH, height), dpi=100)
        _write(figure, 0.45, f"{scene.name}, {scene.kind}-facing", fontsize=24, fontweight="bold")
        _draw_cameras(figure, scene)
        top = TITLE + CAMERAS
        for section in sections:
            _draw_section(figure, section, top)
            top += section.height
    return figure


def _draw_cameras(figure: Figure, scene: Scene) -> None:
    half, below = (WIDTH - GAP) / 2, TITLE + 0.3
    side = figure.add_axes(_place(figure, 0, below, half, 5.6), projection="3d")
    plan = figure.add_axes(_place(figure, half + 0.6, below, half - 1, 5.4))
    draw_cameras(scene, side, plan)
    _write(figure, below - 0.05, "in perspective")
    _write(figure, below - 0.05, "from above, in world units from the middle of the box", half)
    at = (0.5, 1 - (TITLE + CAMERAS - 0.2) / figure.get_figheight())
    figure.legend(loc="center", bbox_to_anchor=at, ncols=6, frameon=False)


def _draw_section(figure: Figure, section: Section, top: float) -> None:
    _write(figure, top + HEADING - 0.15, section.heading, fontsize=17)
    width = (WIDTH - (COLUMNS + 1) * GAP) / COLUMNS
    for i, row in enumerate(section.rows):
        below = top + HEADING + i * (section.tile_height + CAPTION)
        for k, tile in enumerate(row):
            if tile is not None:
                left = GAP + k * (width + GAP)
                axes = figure.add_axes(_place(figure, left, below, width, section.tile_height))
                axes.imshow(tile[0])
                axes.set(xticks=[], yticks=[], xlabel=tile[1], anchor="N")


def _place(figure: Figure, left: float, top: float, width: float, height: float) -> Rectangle:
    """Shares of a figure of a rectangle in inches, counted from its top left corner."""
    page = figure.get_figheight()
    return left / WIDTH, 1 - (top + height) / page, width / WIDTH, height / page


def _write(figure: Figure, top: float, text: str, left: float = 0.0, **style: Any) -> None:
    figure.text((left + GAP) / WIDTH, 1 - top / figure.get_figheight(), text, **style)


def _static_section(views: Views) -> Section:
    tiles = [(shown(views, k), short_name(views.names[k])) for k in evenly(len(views), COLUMNS)]
    return Section(f"Static training set: {len(views)} images", [tiles], _tile_height(views))


def _dynamic_sections(views: Views) -> list[Section]:
    """Sample images of the dynamic views, and below the flow of the same images."""
    rows, height = sample_images(views), _tile_height(views)
    label = {
        k: f"view {int(views.view[k])}, time {float(views.times[k]):.2f}"
        for row in rows
        for k in row
    }
    numbers, times = len(set(views.view.tolist())), len(set(views.times.tolist()))
    motion = "a moving camera" if numbers == len(views) else f"{numbers} fixed views"
    heading = f"Dynamic training set: {motion}, {times} times"
    sections = [
        Section(heading, [[(shown(views, k), label[k]) for k in row] for row in rows], height)
    ]
    if views.flow is None:
        return sections
    longest, flowing = flow_scale(views.flow), {image for image, _ in frame_pairs(views)}
    tiles = [
        [(_flow_image(views.flow, k, longest), label[k]) if k in flowing else None for k in row]
        for row in rows
    ]
    # The first image of a view has no frame before it.
    tiles[0][0] = (to_bytes(flow_wheel(300)).numpy(), f"rim: {longest:.3g} px or more")
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


def flow_scale(flow: OpticalFlow) -> float:
    """The length in pixels that is shown saturated: 99 % of the valid flow is shorter."""
    # Every ninth pixel is enough; all of a large scene's flow at once would be copied.
    vectors, valid = flow.vectors[:, ::3, ::3], flow.valid[:, ::3, ::3]
    lengths = vectors[valid].norm(dim=-1)
    lengths = lengths[torch.isfinite(lengths)]
    return max(float(np.quantile(lengths.numpy(), 0.99)), 1e-3) if len(lengths) else 1.0


def shown(views: Views, image: int) -> np.ndarray:
    """An image as RGB (H', W', 3) uint8; what its alpha or mask leaves out is chequered."""
    pixels = views.pixels[image].cpu().float() / 255
    opacity = pixels[..., 3:] if views.has_alpha else torch.ones(*pixels.shape[:2], 1)
    if views.valid_mask is not None:
        opacity = opacity * views.valid_mask[image].cpu()[..., None]
    y, x = np.indices(pixels.shape[:2]) // max(1, views.width // 24)
    squares = torch.from_numpy(np.where((x + y) % 2, 0.91, 1.0)).float()[..., None]
    return _smaller(squares + opacity * (pixels[..., :3] - squares))


def _flow_image(flow: OpticalFlow, image: int, longest: float) -> np.ndarray:
    return _smaller(flow_colors(flow.vectors[image], flow.valid[image], longest))


def _smaller(colors: Tensor) -> np.ndarray:
    """Reduced by a whole factor to little more than is shown: a page of full images is large."""
    image = Image.fromarray(to_bytes(colors).numpy())
    return np.asarray(image.reduce(max(1, image.width // 300)))


def _tile_height(views: Views) -> float:
    return min(TALLEST, (WIDTH / COLUMNS - GAP) * views.height / views.width)
