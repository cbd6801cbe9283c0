"""A scene on one page: cameras and boxes, sample images, and optical flow as colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from PIL import Image
from torch import Tensor

from devrf.apps.captured_cameras import frustum_depth
from devrf.apps.inspection.layout import box_middle, box_points, common_up, horizontal_axes
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.pictures.figures import write_figure
from devrf.pictures.images import evenly, flow_colors, flow_wheel, short_name, to_bytes
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import OpticalFlow, Scene, Views

# The page's width, and the heights of its parts, in inches of 100 pixels.
WIDTH = 16.0
CAMERAS = 7.2
HEADING = 0.55
CAPTION = 0.45
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
    write_figure(path, inspection_figure(scene))


def inspection_figure(scene: Scene) -> Figure:
    """The page of a scene: 16 inches wide, 100 pixels each."""
    views = scene.static.train
    tiles = [(shown(views, k), short_name(views.names[k])) for k in evenly(len(views), COLUMNS)]
    static = (f"Static training set: {len(views)} images", [tiles])
    moving = _dynamic_sections(scene.dynamic.train) if scene.moves else []
    sections: list[Section] = [static, *moving]
    tile = min(TALLEST, WIDTH / COLUMNS * views.height / views.width)
    heights = [CAMERAS, *(HEADING + len(rows) * (tile + CAPTION) for _, rows in sections)]
    with matplotlib.rc_context(STYLE):
        figure = Figure((WIDTH, sum(heights)), dpi=100)
        areas = figure.subfigures(len(heights), squeeze=False, height_ratios=heights)
        cameras, *parts = areas.flat
        cameras.suptitle(
            f"{scene.name}, {scene.kind}-facing", x=0.01, ha="left", fontsize=24, fontweight="bold"
        )
        side = cameras.add_axes((0, 0.1, 0.49, 0.78), projection="3d", title="in perspective")
        plan = cameras.add_axes((0.53, 0.13, 0.43, 0.75))
        plan.set_title("from above, in world units from the middle of the box")
        draw_cameras(scene, side, plan)
        cameras.legend(loc="lower center", ncols=6, frameon=False)
        for part, height, (heading, rows) in zip(parts, heights[1:], sections, strict=True):
            part.suptitle(heading, x=0.01, ha="left", fontsize=17)
            part.subplots_adjust(
                left=0.01,
                right=0.99,
                top=1 - HEADING / height,
                bottom=CAPTION / height,
                wspace=0.06,
                hspace=CAPTION / tile,
            )
            places = part.add_gridspec(len(rows), COLUMNS)
            for row, entries in enumerate(rows):
                for column, entry in enumerate(entries):
                    if entry is not None:  # empty axes take as long as others
                        image, label = entry
                        axes = part.add_subplot(places[row, column], anchor="N", xlabel=label)
                        axes.imshow(image)
                        axes.set(xticks=[], yticks=[])
    return figure


def _dynamic_sections(views: Views) -> list[Section]:
    """Sample images of the dynamic views, and below the flow of the same images."""
    samples = sample_images(views)
    shown_images = [k for row in samples for k in row]
    label = {k: f"view {views.view[k]}, time {float(views.times[k]):.2f}" for k in shown_images}
    numbers = len(set(views.view.tolist()))
    times = len(set(views.times.tolist()))
    motion = "a moving camera" if numbers == len(views) else f"{numbers} fixed views"
    rows: list[list[Tile]] = [[(shown(views, k), label[k]) for k in row] for row in samples]
    sections: list[Section] = [(f"Dynamic training set: {motion}, {times} times", rows)]
    if views.flow is None:
        return sections
    longest = flow_scale(views.flow)
    images: dict[int, Tile] = {}
    for k, _ in frame_pairs(views):
        if k in label and (of_image := views.single(k).flow) is not None:
            colors = flow_colors(of_image.vectors[0], of_image.valid[0], longest)
            images[k] = (_smaller(colors), label[k])
    flow: list[list[Tile]] = [[images.get(k) for k in row] for row in samples]
    # The first image of a view has no frame before it.
    flow[0][0] = (to_bytes(flow_wheel(300)).numpy(), f"rim: {longest:.3g} px or more")
    heading = (
        "Optical flow: where each pixel was one frame earlier; the wheel shows the direction, "
        "grey is unknown"
    )
    return [*sections, (heading, flow)]


def sample_images(views: Views) -> list[list[int]]:
    """Rows of images to show: some fixed views at some times, or up to two of a moving camera."""
    order = sorted(range(len(views)), key=lambda k: (float(views.times[k]), k))
    numbers = list(first_images(views))
    if len(numbers) == len(views):
        images = [order[k] for k in evenly(len(order), 2 * COLUMNS)]
        return [images[k : k + COLUMNS] for k in range(0, len(images), COLUMNS)]
    rows = []
    for k in evenly(len(numbers), MOST_VIEWS):
        of_view = [image for image in order if int(views.view[image]) == numbers[k]]
        rows.append([of_view[j] for j in evenly(len(of_view), COLUMNS)])
    return rows


def flow_scale(flow: OpticalFlow) -> float:
    """The length in pixels that is shown saturated: 99 % of the valid flow is shorter."""
    # Every ninth pixel is enough; all of a large scene's flow at once would be copied.
    vectors = flow.vectors[:, ::3, ::3]
    valid = flow.valid[:, ::3, ::3]
    lengths = vectors[valid].norm(dim=-1)
    lengths = lengths[torch.isfinite(lengths)]
    return max(float(np.quantile(lengths.numpy(), 0.99)), 1e-3) if len(lengths) else 1.0


def shown(views: Views, image: int) -> np.ndarray:
    """An image as RGB (H', W', 3) uint8; what its alpha or mask leaves out is chequered."""
    views = views.single(image)
    pixels = views.pixels[0].cpu().float() / 255
    opacity = pixels[..., 3:] if views.has_alpha else torch.ones(*pixels.shape[:2], 1)
    if views.valid_mask is not None:
        opacity = opacity * views.valid_mask[0].cpu()[..., None]
    y, x = np.indices(pixels.shape[:2]) // max(1, views.width // 24)
    squares = torch.from_numpy(np.where((x + y) % 2, 0.91, 1.0)).float()[..., None]
    return _smaller(squares + opacity * (pixels[..., :3] - squares))


def _smaller(colors: Tensor) -> np.ndarray:
    """Colours reduced by a whole factor to little more than is shown, to keep the page small."""
    image = Image.fromarray(to_bytes(colors).numpy())
    return np.asarray(image.reduce(max(1, image.width // 300)))


TRAIN_COLOR = "#d9601a"
TEST_COLOR = "#b3204d"
HALO = [withStroke(linewidth=3, foreground="white")]


class Lines(NamedTuple):
    """Segments (N, 2, 3) in world units that look alike, with their entry in the legend."""

    label: str
    ends: Tensor
    color: str
    width: float


def draw_cameras(scene: Scene, side: Any, plan: Axes) -> None:
    """Draw cameras and boxes, in perspective (an Axes3D) and from above.

    World units from the middle of the box, along east, north and up of the cameras.
    """
    axes = compass(scene)
    middle = box_middle(scene)
    groups = scene_lines(scene)
    flat = [(group.ends - middle) @ axes.T for group in groups]
    for group, ends in zip(groups, flat, strict=True):
        # One curve with a break after each segment.
        path = torch.cat([ends, torch.full_like(ends[:, :1], math.nan)], dim=1).reshape(-1, 3)
        x, y, z = path.T.tolist()
        side.plot(x, y, z, color=group.color, linewidth=group.width, clip_on=False)
        plan.plot(x, y, color=group.color, linewidth=group.width, label=group.label)
    for name, number, position, color in _fixed_views(scene):
        x, y, z = ((position - middle) @ axes.T).tolist()
        side.text(x, y, z, f"  {number}", color=color, fontweight="bold", path_effects=HALO)
        if scene.kind == "inward":  # forward-facing cameras stand above one another
            outward = 26 / max(math.hypot(x, y), 1e-6)  # points
            plan.annotate(
                f"{name} {number}",
                (x, y),
                xytext=(x * outward, y * outward),
                textcoords="offset points",
                color=color,
                fontweight="bold",
                path_effects=HALO,
                ha="center",
                va="center",
            )
    points = torch.cat([ends.reshape(-1, 3) for ends in flat])
    low = points.amin(dim=0).tolist()
    high = points.amax(dim=0).tolist()
    side.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    side.set_box_aspect([b - a for a, b in zip(low, high, strict=True)], zoom=1.15)
    side.locator_params(nbins=5)
    side.view_init(elev=20, azim=-55)
    plan.set_aspect("equal")
    plan.grid(color="0.92")


def compass(scene: Scene) -> Tensor:
    """Rows east, north, up (3, 3) in the world; forward-facing cameras look about north."""
    cameras = scene.static.train.cameras
    up = common_up(cameras)
    up = torch.tensor([0.0, 0.0, 1.0]) if up is None else up
    right = cameras.camera_to_world[:, :, 0].mean(dim=0) if scene.kind == "forward" else None
    return torch.stack([*horizontal_axes(up, right), up])


def scene_lines(scene: Scene) -> list[Lines]:
    """Boxes and cameras as lines; each fixed camera once, not once a frame."""
    size = frustum_depth(scene.static.train.cameras)
    bounds = scene.bounds
    unbounded = scene.kind == "forward"
    lines = [
        Lines("box" + unbounded * " (unbounded, cut off)", box_edges(scene, bounds.box), "0.2", 2)
    ]
    if bounds.motion is not None:
        lines.append(Lines("room for motion", box_edges(scene, bounds.motion), "#1f9e6b", 2))
    for label, views, color, width in (
        ("static views", scene.static.train, "#4f7fd0", 1.0),
        ("held-out static", scene.static.test, "#7cc4ea", 1.0),
        ("dynamic views", scene.dynamic.train, TRAIN_COLOR, 2.0),
        ("held-out dynamic", scene.dynamic.test, TEST_COLOR, 2.0),
    )[: 4 if scene.moves else 2]:
        images = list(first_images(views).values())
        ends = frusta(views.cameras[images], size)
        lines.append(Lines(f"{label} ({len(images)})", ends, color, width))
    return lines


def first_images(views: Views) -> dict[int, int]:
    """The first image of each view, by the view's number, ascending."""
    first: dict[int, int] = {}
    for image, number in enumerate(views.view.tolist()):
        first.setdefault(number, image)
    return dict(sorted(first.items()))


def box_edges(scene: Scene, box: Box) -> Tensor:
    """The edges (12, 2, 3) of a box of the scene in world units; an NDC box is a frustum there."""
    corners = box_points(scene, box, (2, 2, 2))
    edges = [corners.unbind(axis) for axis in range(3)]
    return torch.cat([torch.stack([a.reshape(-1, 3), b.reshape(-1, 3)], dim=1) for a, b in edges])


def frusta(cameras: Cameras, depth: float) -> Tensor:
    """N cameras as pyramids ``depth`` high with a tick where up is: (10 · N, 2, 3), world units."""
    corners = cameras.center.new_tensor(
        [[0, 0], [1, 0], [1, 1], [0, 1], [0.35, 0], [0.5, -0.2], [0.65, 0]]
    )
    pixels = corners * cameras.extents[:, None]
    x, y = ((pixels - cameras.center[:, None]) / cameras.focal[:, None]).unbind(-1)
    local = depth * torch.stack([x, -y, -torch.ones_like(x)], dim=-1)
    pose = cameras.camera_to_world
    ends = local @ pose[:, :, :3].transpose(1, 2) + pose[:, None, :, 3]
    ends = torch.cat([pose[:, None, :, 3], ends], dim=1)  # 0 is the eye, 1 to 4 the corners
    pairs = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [5, 6], [6, 7]]
    return ends[:, pairs].reshape(-1, 2, 3)


def _fixed_views(scene: Scene) -> list[tuple[str, int, Tensor, str]]:
    """Name, number, position (3,) and colour of the dynamic views whose cameras stand still."""
    return [
        (name, number, views.cameras.positions[image], color)
        for name, views, color in (
            ("view", scene.dynamic.train, TRAIN_COLOR),
            ("test", scene.dynamic.test, TEST_COLOR),
        )
        if len(first := first_images(views)) < len(views)
        for number, image in first.items()
    ]
