"""Text in pictures, fitted to its place."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import matplotlib
from PIL import ImageFont


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """matplotlib's own font, which has more letters than Pillow's, ``size`` pixels high."""
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size)


def fitted_font(text: str, size: int, width: int) -> ImageFont.FreeTypeFont:
    """The largest font up to ``size`` in which the text is no wider than ``width`` pixels."""
    needed = font(size).getlength(text)
    return font(max(1, int(size * min(1.0, 0.98 * width / max(needed, 1.0)))))
