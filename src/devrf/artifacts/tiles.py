"""Rows of a page: titles, and images with a label each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from devrf.artifacts.colors import to_bytes
from devrf.artifacts.drawing import Color

WIDTH = 1600
MARGIN = 28
GAP = 12
INK: Color = (38, 44, 56)
PALE: Color = (112, 120, 134)
FRAME: Color = (226, 229, 234)
# Squares of the pattern behind mattes.
LIGHT, DARK, SQUARE = 255, 236, 10

Tile = tuple[Image.Image, str]


def strip(tiles: Sequence[Tile]) -> Image.Image:
    """Images in a row of a page, each with its label below."""
    height = max((image.height for image, _ in tiles), default=0)
    row = Image.new("RGB", (WIDTH, height + 30), "white")
    pen = ImageDraw.Draw(row)
    x = MARGIN
    for image, label in tiles:
        row.paste(image, (x, 0))
        pen.rectangle([x - 1, -1, x + image.width, image.height], outline=FRAME)
        pen.text((x, height + 5), fitting(label, image.width), fill=PALE, font=font(14))
        x += image.width + GAP
    return row


def title(text: str, words: str, size: int = 20) -> Image.Image:
    """A title of a page with some words after it; ``size`` is the title's, in pixels."""
    row = Image.new("RGB", (WIDTH, size + 32), "white")
    pen, large = ImageDraw.Draw(row), font(size)
    line = row.height - 12
    pen.text((MARGIN, line), text, fill=INK, font=large, anchor="ls")
    at = MARGIN + large.getlength(text) + 14
    pen.text((at, line), words, fill=PALE, font=font(15), anchor="ls")
    return row


def shown(pixels: Tensor, size: tuple[int, int]) -> Image.Image:
    """An image (H, W, 3 or 4) uint8 at another size; what the matte leaves out is chequered."""
    image = Image.fromarray(np.ascontiguousarray(pixels.cpu().numpy()))
    image = resized(image, size)
    if image.mode != "RGBA":
        return image
    x, y = np.arange(size[0]) // SQUARE, np.arange(size[1]) // SQUARE
    squares = np.where((x[None] + y[:, None]) % 2, DARK, LIGHT).astype(np.uint8)
    paper = Image.fromarray(squares).convert("RGB")
    paper.paste(image, mask=image.getchannel("A"))
    return paper


def resized(image: Image.Image, size: tuple[int, int]) -> Image.Image:
    """Smoothly smaller; larger by pixels that can be seen, for they are what there is."""
    larger = size[0] > image.width
    return image.resize(size, Image.Resampling.NEAREST if larger else Image.Resampling.LANCZOS)


def picture(colors: Tensor) -> Image.Image:
    """An image (H, W, 3) in [0, 1]."""
    return Image.fromarray(to_bytes(colors).numpy())


def font(size: int) -> ImageFont.FreeTypeFont:
    """Pillow's own font, ``size`` pixels high."""
    found = ImageFont.load_default(size)
    assert isinstance(found, ImageFont.FreeTypeFont)
    return found


def fitting(text: str, width: int) -> str:
    """The text; where it is wider than ``width`` pixels, its beginning is left out."""
    words = text
    while len(words) > 2 and font(14).getlength(words) > width:
        text = text[1:]
        words = f"…{text}"
    return words
