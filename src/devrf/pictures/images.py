"""Images: depth, errors and flow as colours; grids; files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from kornia.color import ColorMap, apply_colormap, hsv_to_rgb
from PIL import Image, ImageDraw
from torch import Tensor

from devrf.pictures.video_file import fitted_font, font
from devrf.system.files import atomic_write

# Grey level of invalid flow; valid flow is white or coloured.
UNKNOWN = 0.85
# White pixels between images side by side.
GAP = 4
# Longest name that fits below a small image, in characters.
LONGEST_NAME = 30
# Grey levels of text, and of the lines around images, most of which have a white background.
INK = "#262626"
LINE = "#c8c8c8"
# The height of text: its share of an image's height, and its limits in pixels.
TEXT = 0.05
SMALLEST_TEXT = 9
LARGEST_TEXT = 26


def depth_colors(depth: Tensor, opacity: Tensor, near: float, far: float) -> Tensor:
    """Depth (H, W) as RGB (H, W, 3) in [0, 1]: ``near`` bright, ``far`` dark, empty space white."""
    closeness = 1 - ((depth - near) / (far - near)).clamp(0, 1)
    colors = _mapped(closeness, "viridis")
    return 1 + opacity[..., None] * (colors - 1)


def error_colors(prediction: Tensor, truth: Tensor) -> Tensor:
    """The mean absolute difference of (H, W, 3) images as RGB: 0 is black, 0.25 or more white."""
    return _mapped((4 * (prediction - truth).abs().mean(dim=-1)).clamp(0, 1), "hot")


def flow_colors(vectors: Tensor, valid: Tensor, full: float) -> Tensor:
    """Optical flow as RGB (H, W, 3): hue is direction, saturation length, white is no motion.

    ``vectors`` (H, W, 2) are in pixels, x to the right, then y down; where they are not ``valid``
    the picture is grey. From ``full`` pixels on colours are saturated.
    """
    x, y = torch.where(valid[..., None], vectors, 0.0).float().unbind(-1)
    hue = torch.atan2(-y, x) % (2 * math.pi)  # counted upwards, as angles are drawn
    saturation = (torch.hypot(x, y) / max(full, 1e-6)).clamp(0, 1)
    hsv = torch.stack([hue, saturation, 1 - 0.1 * saturation])
    colors: Tensor = hsv_to_rgb(hsv[None])[0].permute(1, 2, 0)
    return torch.where(valid[..., None], colors, UNKNOWN)


def flow_wheel(side: int) -> Tensor:
    """The key to :func:`flow_colors` (side, side, 3): a disc of all directions, white outside."""
    at = (torch.arange(side) + 0.5) / side * 2 - 1
    y, x = torch.meshgrid(at, at, indexing="ij")
    vectors = torch.stack([x, y], dim=-1)
    inside = torch.hypot(x, y) <= 1
    return torch.where(inside[..., None], flow_colors(vectors, inside, 1.0), 1.0)


def to_bytes(image: Tensor) -> Tensor:
    """An image in [0, 1] as uint8, rounded; one of uint8 as it is."""
    if image.dtype == torch.uint8:
        return image
    return image.clamp(0, 1).mul_(255).round_().to(torch.uint8)


def _mapped(values: Tensor, name: str) -> Tensor:
    table = ColorMap(base=name, num_colors=256)
    return apply_colormap(values[None, None].cpu().float(), table)[0].permute(1, 2, 0)


def write_image(path: Path, image: Tensor) -> None:
    """Write an image (H, W, 3), in [0, 1] or uint8, as a PNG."""
    with atomic_write(path) as partial:
        iio.imwrite(partial, to_bytes(image).numpy(), extension=".png")


def side_by_side(images: Sequence[Tensor]) -> Tensor:
    """Images (H, W, 3) of one height in a row, with ``GAP`` white pixels between them."""
    padded = [torch.nn.functional.pad(image, (0, 0, 0, GAP), value=1.0) for image in images]
    return torch.cat(padded, dim=1)[:, :-GAP]


def short_name(name: str) -> str:
    """The name of an image's file as a label, without folders; a long name is cut to its end."""
    name = Path(name).name
    return name if len(name) <= LONGEST_NAME else f"…{name[1 - LONGEST_NAME :]}"


def evenly(count: int, max_count: int) -> list[int]:
    """At most ``max_count`` of the positions 0 … count − 1, evenly spread, both ends among them."""
    return [round(k) for k in np.linspace(0, count - 1, min(count, max_count))]


def image_grid(
    rows: Sequence[Sequence[Tensor]],
    headings: Sequence[str] = (),
    labels: Sequence[Sequence[str]] = (),
    text: int | None = None,
) -> Tensor:
    """A picture (H', W', 3), uint8, of images (H, W, 3) in [0, 1], and fitted text.

    Images of several sizes are in the middle of tiles for the largest. ``headings`` stand above
    each column, ``labels`` are lines left of each row. ``text`` is its height in pixels; None: a
    twentieth of that of the images, within limits.
    """
    height = max(image.shape[0] for row in rows for image in row)
    width = max(image.shape[1] for row in rows for image in row)
    size = text or min(max(round(TEXT * height), SMALLEST_TEXT), LARGEST_TEXT)
    gap = size // 3 + 1
    widths = (font(size).getlength(line) for label in labels for line in label)
    left = round(max(widths, default=-3 * gap)) + 3 * gap
    top = 2 * size if headings else 0
    page = Image.new(
        "RGB",
        (left + len(rows[0]) * (width + gap) - gap, top + len(rows) * (height + gap) - gap),
        "white",
    )
    pen = ImageDraw.Draw(page)
    columns = [left + k * (width + gap) for k in range(len(rows[0]))]
    for x, heading in zip(columns, headings, strict=False):
        pen.text((x + width / 2, top / 2), heading, INK, fitted_font(heading, size, width), "mm")
    for number, row in enumerate(rows):
        y = top + number * (height + gap)
        for x, image in zip(columns, row, strict=True):
            page.paste(Image.fromarray(centred(image, height, width).cpu().numpy()), (x, y))
            if x != columns[0]:
                pen.line((x - gap // 2 - 1, y, x - gap // 2 - 1, y + height - 1), LINE)
        if number:
            pen.line((0, y - gap // 2 - 1, page.width, y - gap // 2 - 1), LINE)
        if labels:
            lines = "\n".join(labels[number])
            middle = (left / 2, y + height / 2)
            pen.multiline_text(middle, lines, INK, font(size), "mm", spacing=gap, align="center")
    return torch.from_numpy(np.array(page))


def centred(image: Tensor, height: int, width: int) -> Tensor:
    """An image (H, W, 3), in [0, 1] or uint8, in the middle of a white one: uint8."""
    top = (height - image.shape[0]) // 2
    left = (width - image.shape[1]) // 2
    bottom = height - image.shape[0] - top
    right = width - image.shape[1] - left
    return torch.nn.functional.pad(to_bytes(image), (0, 0, left, right, top, bottom), value=255)


def scaled(image: Tensor, height: int, width: int | None = None) -> Tensor:
    """An image (H, W, 3) in [0, 1], smoothly resized; without ``width`` it keeps its aspect."""
    if width is None:
        width = max(1, round(image.shape[1] * height / image.shape[0]))
    if tuple(image.shape[:2]) == (height, width):
        return image
    source = Image.fromarray(to_bytes(image).cpu().numpy())
    resized = source.resize((width, height), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(resized)).float() / 255
