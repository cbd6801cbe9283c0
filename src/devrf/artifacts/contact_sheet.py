"""A contact sheet of held-out views: prediction, truth and error, with labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from devrf.artifacts.colors import error_colors
from devrf.artifacts.images import enlarged, evenly, short_name, side_by_side, write_image
from devrf.evaluation.held_out import HeldOutView

# Narrower images are enlarged, so that their labels are readable.
LEAST_WIDTH = 240
HEADING = ("prediction", "truth", "error")


def write_contact_sheet(path: Path, views: Sequence[HeldOutView], rows: int = 6) -> Tensor:
    """Write a PNG with ``rows`` of the views, evenly spread, each with name, time and PSNR.

    Returns:
        The sheet (H, W, 3) in [0, 1].
    """
    parts: list[Tensor] = []
    for view in (views[k] for k in evenly(len(views), rows)):
        images = [view.prediction, view.truth, error_colors(view.compared, view.truth)]
        strip = side_by_side([enlarged(image, width=LEAST_WIDTH) for image in images])
        labels = (short_name(view.name), f"time {view.time:.2f}", f"PSNR {view.psnr:.2f} dB")
        parts += [strip, _label_row(strip.shape[1], labels)]
    sheet = torch.cat([_label_row(parts[0].shape[1], HEADING), *parts])
    write_image(path, sheet)
    return sheet


def _label_row(width: int, labels: Sequence[str]) -> Tensor:
    """Black text on white (H, width, 3), one label for each of as many columns."""
    column = width // len(labels)
    size = column // 16
    row = Image.new("RGB", (width, 2 * size), "white")
    pen, font = ImageDraw.Draw(row), ImageFont.load_default(size)
    for k, label in enumerate(labels):
        pen.text((k * column + size // 2, size // 3), label, fill="black", font=font)
    return torch.from_numpy(np.array(row)).float() / 255
