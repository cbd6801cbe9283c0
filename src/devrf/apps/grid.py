"""Images in a grid, with a heading above each column and lines of text beside each row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from devrf.apps.colors import to_bytes
from devrf.apps.lettering import fitted_font, font

# Grey levels of text, and of the lines around images, most of which have a white background.
INK, LINE = "#262626", "#c8c8c8"
# Text is so high for each pixel of an image's height, and between these heights, in pixels.
TEXT, SMALLEST_TEXT, LARGEST_TEXT = 0.05, 9, 26


def image_grid(
    rows: Sequence[Sequence[Tensor]],
    headings: Sequence[str] = (),
    labels: Sequence[Sequence[str]] = (),
    text: int | None = None,
) -> Tensor:
    """A picture of all images, with text that is fitted to its place, never cut off.

    Args:
        rows: images (H, W, 3) in [0, 1], all of one size, as many in each row.
        headings: text above each column; none: no line of them.
        labels: lines of text left of each row; none: no room for them.
        text: its height in pixels; None: a twentieth of that of the images, within limits.

    Returns:
        (H', W', 3) in [0, 1].
    """
    height, width = rows[0][0].shape[:2]
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
            page.paste(Image.fromarray(to_bytes(image).cpu().numpy()), (x, y))
            if x != columns[0]:
                pen.line((x - gap // 2 - 1, y, x - gap // 2 - 1, y + height - 1), LINE)
        if number:
            pen.line((0, y - gap // 2 - 1, page.width, y - gap // 2 - 1), LINE)
        if labels:
            lines = "\n".join(labels[number])
            middle = (left / 2, y + height / 2)
            pen.multiline_text(middle, lines, INK, font(size), "mm", spacing=gap, align="center")
    return torch.from_numpy(np.array(page)).float() / 255


def scaled(image: Tensor, height: int, width: int | None = None) -> Tensor:
    """An image (H, W, 3) in [0, 1] of another size, smoothly interpolated.

    Args:
        image: the image.
        height: the new height in pixels.
        width: the new width; None: in proportion.
    """
    if width is None:
        width = max(1, round(image.shape[1] * height / image.shape[0]))
    if tuple(image.shape[:2]) == (height, width):
        return image
    source = Image.fromarray(to_bytes(image).cpu().numpy())
    resized = source.resize((width, height), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(resized)).float() / 255
