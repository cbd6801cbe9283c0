"""A contact sheet of held-out views: prediction, truth and error, with labels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from devrf.artifacts.colors import error_colors
from devrf.artifacts.images import short_name, write_image
from devrf.evaluation.held_out import HeldOutView

GAP = 4
# Narrower images are enlarged by whole pixels, so that their labels are readable.
LEAST_WIDTH = 240
HEADING = ("prediction", "truth", "error")


def write_contact_sheet(path: Path, views: Sequence[HeldOutView], rows: int = 6) -> Tensor:
    """Write a PNG with ``rows`` of the views, evenly spread, each with name, time and PSNR.

    Returns:
        The sheet (H, W, 3) in [0, 1].
    """
    chosen = [views[round(k)] for k in np.linspace(0, len(views) - 1, min(rows, len(views)))]
    parts: list[Tensor] = []
    for view in chosen:
        images = [view.prediction, view.truth, error_colors(view.compared, view.truth)]
        factor = math.ceil(LEAST_WIDTH / view.truth.shape[1])
        strip = side_by_side([_enlarged(image, factor) for image in images])
        labels = (short_name(view.name), f"time {view.time:.2f}", f"PSNR {view.psnr:.2f} dB")
        parts += [strip, _label_row(strip.shape[1], labels)]
    sheet = torch.cat([_label_row(parts[0].shape[1], HEADING), *parts])
    write_image(path, sheet)
    return sheet


def side_by_side(images: Sequence[Tensor], gap: int = GAP) -> Tensor:
    """Images (H, W, 3) of one height in a row, with white between them."""
    white = torch.ones(images[0].shape[0], gap, 3)
    parts: list[Tensor] = []
    for image in images:
        parts += [white, image] if parts else [image]
    return torch.cat(parts, dim=1)


def _enlarged(image: Tensor, factor: int) -> Tensor:
    return image.repeat_interleave(factor, dim=0).repeat_interleave(factor, dim=1)


def _label_row(width: int, labels: Sequence[str]) -> Tensor:
    """Black text on white (H, width, 3), one label for each of as many columns."""
    column = width // len(labels)
    size = column // 16
    row = Image.new("RGB", (width, 2 * size), "white")
    pen, font = ImageDraw.Draw(row), ImageFont.load_default(size)
    for k, label in enumerate(labels):
        pen.text((k * column + size // 2, size // 3), label, fill="black", font=font)
    return torch.from_numpy(np.array(row)).float() / 255
