"""A scene on one page: cameras and box, a contact sheet, and the optical flow as colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from devrf.artifacts import scene_sketch
from devrf.artifacts.colors import flow_colors, flow_wheel
from devrf.artifacts.drawing import Color
from devrf.artifacts.scene_sketch import Sketch, fixed_cameras, grid_step, sketches
from devrf.artifacts.tiles import (
    GAP,
    INK,
    MARGIN,
    PALE,
    WIDTH,
    Tile,
    font,
    picture,
    resized,
    shown,
    strip,
    title,
)
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Scene, Views
from devrf.system.files import atomic_write

PANEL_HEIGHT = 540
COLUMNS = 6
# No image of the contact sheet is higher, so that portrait images do not fill a page each.
TALLEST = 260
MOST_VIEWS = 4
WHEEL = 76


def write_inspection_picture(path: Path, scene: Scene) -> None:
    """Write the page of a scene as a PNG, 1600 pixels wide."""
    with atomic_write(path) as partial:
        inspection_picture(scene).save(partial, format="PNG")


def inspection_picture(scene: Scene) -> Image.Image:
    """The page of a scene: RGB, 1600 pixels wide and as high as it needs to be."""
    train = scene.dynamic.train
    rows = [
        title(scene.name, f"{scene.kind}-facing", 30),
        _cameras(scene),
        title("at rest", f"{_count(len(scene.static.train), 'static view')} to learn from"),
        strip(_static_tiles(scene.static.train)),
        title("in motion", _motion_words(train)),
        *(strip(tiles) for tiles in _moving_tiles(train, _chosen(train), None)),
    ]
    if train.flow is not None:
        full = flow_scale(train)
        later = [i for i, _ in frame_pairs(train)]
        rows.append(_flow_title(full))
        rows += [strip(tiles) for tiles in _moving_tiles(train, _chosen(train, set(later)), full)]
    page = Image.new("RGB", (WIDTH, sum(row.height for row in rows) + MARGIN), "white")
    top = 0
    for row in rows:
        page.paste(row, (0, top))
        top += row.height
    return page


def flow_scale(views: Views) -> float:
    """The length in pixels that is shown saturated: all but the longest hundredth are shorter."""
    assert views.flow is not None
    lengths = [
        vectors[valid].norm(dim=-1)[::7]  # a seventh says as much
        for vectors, valid in zip(views.flow.vectors, views.flow.valid, strict=True)
    ]
    every = torch.cat(lengths)
    every = every[torch.isfinite(every)]
    if len(every) == 0:
        return 1.0
    return max(float(every.sort().values[int(0.99 * (len(every) - 1))]), 1e-3)


def evenly(count: int, most: int) -> list[int]:
    """At most ``most`` of the positions 0 … count − 1, evenly spread, both ends among them."""
    if count <= most:
        return list(range(count))
    return [round(k * (count - 1) / (most - 1)) for k in range(most)]


def _chosen(views: Views, among: set[int] | None = None) -> list[list[int]]:
    """Images to show, a row a view: few views, few times. A moving camera's go on in rows."""
    numbers = [number for number, _ in fixed_cameras(views.cameras, views.view)]
    order = sorted(range(len(views)), key=lambda i: (float(views.times[i]), i))
    order = [i for i in order if among is None or i in among]
    if len(numbers) == len(views):
        some = [order[k] for k in evenly(len(order), 2 * COLUMNS)]
        return [some[k : k + COLUMNS] for k in range(0, len(some), COLUMNS)]
    rows = []
    for k in evenly(len(numbers), MOST_VIEWS):
        own = [i for i in order if int(views.view[i]) == numbers[k]]
        rows.append([own[j] for j in evenly(len(own), COLUMNS)])
    return [row for row in rows if row]


def _static_tiles(views: Views) -> list[Tile]:
    return [
        (shown(counted_pixels(views, k), _tile_size(views)), Path(views.names[k]).name)
        for k in evenly(len(views), COLUMNS)
    ]


def _moving_tiles(
    views: Views, rows: Sequence[Sequence[int]], full: float | None
) -> list[list[Tile]]:
    """Rows of labelled images, or of their flow where ``full`` says what is saturated."""
    size = _tile_size(views)
    tiles: list[list[Tile]] = []
    for row in rows:
        tiles.append([])
        for k in row:
            label = f"view {int(views.view[k])}, time {float(views.times[k]):.2f}"
            if full is None or views.flow is None:
                tiles[-1].append((shown(counted_pixels(views, k), size), label))
            else:
                colors = flow_colors(views.flow.vectors[k], views.flow.valid[k], full)
                tiles[-1].append((resized(picture(colors), size), label))
    return tiles


def counted_pixels(views: Views, image: int) -> Tensor:
    """An image's pixels (H, W, 3 or 4); those that do not count are clear."""
    pixels = views.pixels[image]
    if views.valid_mask is None:
        return pixels
    alpha = views.valid_mask[image].to(torch.uint8)[..., None] * 255
    return torch.cat(
        [pixels[..., :3], torch.minimum(alpha, pixels[..., 3:]) if views.has_alpha else alpha],
        dim=-1,
    )


def _tile_size(views: Views) -> tuple[int, int]:
    width = (WIDTH - 2 * MARGIN - (COLUMNS - 1) * GAP) / COLUMNS
    scale = min(width / views.width, TALLEST / views.height)
    return max(1, round(views.width * scale)), max(1, round(views.height * scale))


def _flow_title(full: float) -> Image.Image:
    row = Image.new("RGB", (WIDTH, WHEEL + 26), "white")
    wheel = picture(flow_wheel(3 * WHEEL)).resize((WHEEL, WHEEL), Image.Resampling.LANCZOS)
    row.paste(wheel, (MARGIN, 14))
    pen, x = ImageDraw.Draw(row), MARGIN + WHEEL + 16
    pen.text((x, 48), "optical flow", fill=INK, font=font(20), anchor="ls")
    words = (
        "to the same view one frame earlier: the wheel shows which way a pixel came from; "
        f"its rim is {full:.3g} px or more, grey is not known"
    )
    pen.text((x, 74), words, fill=PALE, font=font(15), anchor="ls")
    return row


def _motion_words(views: Views) -> str:
    numbers, times = len(set(views.view.tolist())), len(set(views.times.tolist()))
    if numbers == len(views):
        return f"a moving camera, {_count(len(views), 'image')}"
    return f"{_count(numbers, 'fixed view')} to learn from, {_count(times, 'time')}"


def _count(number: int, word: str) -> str:
    return f"{number} {word}" + "s" * (number != 1)


def _cameras(scene: Scene) -> Image.Image:
    """Cameras and boxes from two sides, and what the colours mean."""
    width = (WIDTH - 2 * MARGIN - GAP) // 2
    row = Image.new("RGB", (WIDTH, PANEL_HEIGHT + 44), "white")
    for k, sketch in enumerate(sketches(scene, width, PANEL_HEIGHT)):
        _number_cameras(sketch, scene)
        ImageDraw.Draw(sketch.image).text((14, 12), sketch.title, fill=PALE, font=font(16))
        row.paste(sketch.image, (MARGIN + k * (width + GAP), 0))
    pen, x, y = ImageDraw.Draw(row), float(MARGIN), PANEL_HEIGHT + 23
    for color, words in _legend(scene):
        pen.rectangle([x, y - 5, x + 18, y + 5], fill=color)
        pen.text((x + 26, y), words, fill=INK, font=font(15), anchor="lm")
        x += 26 + font(15).getlength(words) + 30
    return row


def _legend(scene: Scene) -> list[tuple[Color, str]]:
    static = scene.static
    box = "box" if scene.kind == "inward" else "box (without end; cut off here)"
    entries = [
        (scene_sketch.STATIC, f"static ({len(static.train)})"),
        (scene_sketch.STATIC_TEST, f"static, held out ({len(static.test)})"),
        (scene_sketch.DYNAMIC, "dynamic"),
        (scene_sketch.DYNAMIC_TEST, "dynamic, held out"),
        (scene_sketch.BOX, box),
    ]
    if scene.bounds.motion is not None:
        entries.append((scene_sketch.MOTION, "room for motion"))
    return [*entries, (scene_sketch.GROUND, f"a cell is {grid_step(scene):g} world units")]


def _number_cameras(sketch: Sketch, scene: Scene) -> None:
    """Write the number of each fixed dynamic view beside its camera."""
    pen = ImageDraw.Draw(sketch.image)
    for views, color in (
        (scene.dynamic.train, scene_sketch.DYNAMIC),
        (scene.dynamic.test, scene_sketch.DYNAMIC_TEST),
    ):
        fixed = fixed_cameras(views.cameras, views.view)
        if len(fixed) == len(views):
            continue
        for number, image in fixed:
            pixel, _ = sketch.projection.pixels(views.cameras.positions[image])
            x, y = pixel.tolist()
            pen.text(
                (x + 11, y - 11),
                f"{number}",
                fill=color,
                font=font(17),
                anchor="lm",
                stroke_width=3,
                stroke_fill=scene_sketch.PAPER,
            )
