"""A scene on one page: cameras and boxes, sample images, and optical flow as colours."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from PIL import Image
from torch import Tensor

from devrf.apps.colors import flow_colors, flow_wheel, to_bytes
from devrf.apps.images import evenly, short_name
from devrf.apps.inspection.camera_plot import draw_cameras, first_images
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import OpticalFlow, Scene, Views
from devrf.system.files import atomic_write

# Inches, of which each is 100 pixels: the page's width; the heights of its parts.
WIDTH, CAMERAS, HEADING, CAPTION = 16.0, 7.2, 0.55, 0.45
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
# An image (H, W, 3) uint8 and its label; None leaves a place empty.
Tile = tuple[np.ndarray, str] | None
# A heading, and rows of tiles below it.
Section = tuple[str, Sequence[Sequence[Tile]]]


def write_inspection_picture(path: Path, scene: Scene) -> None:
    """Write the page of a scene as a PNG, 1600 pixels wide and as high as it needs to be."""
    with atomic_write(path) as partial:
        inspection_figure(scene).savefig(partial, format="png", dpi="figure")


def inspection_figure(scene: Scene) -> Figure:
    """The page of a scene: 16 inches wide, 100 pixels each."""
    views = scene.static.train
    tiles = [(shown(views, k), short_name(views.names[k])) for k in evenly(len(views), COLUMNS)]
    static = f"Static training set: {len(views)} images", [tiles]
    moving = _dynamic_sections(scene.dynamic.train) if scene.moves else []
    sections: list[Section] = [static, *moving]
    tile = min(TALLEST, WIDTH / COLUMNS * views.height / views.width)
    heights = [CAMERAS, *(HEADING + len(rows) * (tile + CAPTION) for _, rows in sections)]
    with matplotlib.rc_context(STYLE):
        figure = Figure((WIDTH, sum(heights)), dpi=100)
        areas = figure.subfigures(len(heights), squeeze=False, height_ratios=heights)
        cameras, *parts = areas.flat
        _title(cameras, f"{scene.name}, {scene.kind}-facing", fontsize=24, fontweight="bold")
        side = cameras.add_axes((0, 0.1, 0.49, 0.78), projection="3d", title="in perspective")
        plan = cameras.add_axes((0.53, 0.13, 0.43, 0.75))
        plan.set_title("from above, in world units from the middle of the box")
        draw_cameras(scene, side, plan)
        cameras.legend(loc="lower center", ncols=6, frameon=False)
        for part, height, (heading, rows) in zip(parts, heights[1:], sections, strict=True):
            _title(part, heading, fontsize=17)
            part.subplots_adjust(
                left=0.01,
                right=0.99,
                top=1 - HEADING / height,
                bottom=CAPTION / height,
                wspace=0.06,
                hspace=CAPTION / tile,
            )
            places = part.subplots(len(rows), COLUMNS, squeeze=False)
            for axes, row in zip(places, rows, strict=True):
                _draw_row(axes, row)
    return figure


def _title(part: SubFigure, text: str, **style: Any) -> None:
    part.suptitle(text, x=0.01, ha="left", **style)


def _draw_row(places: Sequence[Axes], tiles: Sequence[Tile]) -> None:
    for axes, tile in zip_longest(places, tiles):
        if tile is None:
            axes.set_axis_off()
        else:
            axes.imshow(tile[0])
            axes.set(xticks=[], yticks=[], xlabel=tile[1], anchor="N")


def _dynamic_sections(views: Views) -> list[Section]:
    """Sample images of the dynamic views, and below the flow of the same images."""
    samples = sample_images(views)
    label = {
        k: f"view {int(views.view[k])}, time {float(views.times[k]):.2f}"
        for row in samples
        for k in row
    }
    numbers, times = len(set(views.view.tolist())), len(set(views.times.tolist()))
    motion = "a moving camera" if numbers == len(views) else f"{numbers} fixed views"
    rows: list[list[Tile]] = [[(shown(views, k), label[k]) for k in row] for row in samples]
    sections: list[Section] = [(f"Dynamic training set: {motion}, {times} times", rows)]
    if views.flow is None:
        return sections
    longest, flowing = flow_scale(views.flow), {image for image, _ in frame_pairs(views)}
    flow: list[list[Tile]] = [
        [(_flow_image(views.flow, k, longest), label[k]) if k in flowing else None for k in row]
        for row in samples
    ]
    # The first image of a view has no frame before it.
    flow[0][0] = (to_bytes(flow_wheel(300)).numpy(), f"rim: {longest:.3g} px or more")
    heading = (
        "Optical flow: where each pixel was one frame earlier; the wheel shows the direction, "
        "grey is unknown"
    )
    return [*sections, (heading, flow)]


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
