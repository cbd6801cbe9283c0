"""Held-out views as pictures: beside the truth, and in contact sheets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

import torch
from torch import Tensor

from devrf.evaluation.held_out import HeldOutView
from devrf.pictures.images import (
    depth_colors,
    error_colors,
    evenly,
    image_grid,
    scaled,
    short_name,
    side_by_side,
    write_image,
)

# The least and the largest height of images in contact sheets; others are resized.
MIN_HEIGHT = 300
MAX_HEIGHT = 640
HEADINGS = ("truth", "rendered", "error: 0 to 0.25 or more", "depth: near is bright")


def preview(view: HeldOutView) -> dict[str, Tensor]:
    """Pictures (H, W', 3) in [0, 1] of a view: beside the truth and the error, and its depth."""
    near, far = _depth_range([view])
    error = error_colors(view.compared, view.truth)
    return {
        "view": side_by_side([view.prediction, view.truth, error]),
        "depth": depth_colors(view.depth, view.opacity, near, far),
    }


def write_contact_sheet(path: Path, views: Sequence[HeldOutView], rows: int = 6) -> Tensor:
    """Write a PNG of ``rows`` of the views with name, time and scores; the sheet (H, W, 3), uint8.

    Times are left out if all are 0.
    """
    selected = [views[k] for k in evenly(len(views), rows)]
    near, far = _depth_range(selected)
    height = min(max(selected[0].truth.shape[0], MIN_HEIGHT), MAX_HEIGHT)
    rows_of_tiles = []
    labels = []
    for view in selected:
        error = error_colors(view.compared, view.truth)
        depth = depth_colors(view.depth, view.opacity, near, far)
        tiles = (view.truth, view.prediction, error, depth)
        rows_of_tiles.append([scaled(tile, height) for tile in tiles])
        name = wrap(short_name(view.name), 16, break_long_words=False, break_on_hyphens=False)
        scores = (f"PSNR {view.psnr:.2f} dB", f"SSIM {view.ssim:.3f}")
        time = [f"time {view.time:.2f}"] if any(view.time for view in views) else []
        labels.append([*name, *time, *scores])
    sheet = image_grid(rows_of_tiles, HEADINGS, labels)
    write_image(path, sheet)
    return sheet


def _depth_range(views: Sequence[HeldOutView]) -> tuple[float, float]:
    """The nearest and furthest depth of solid pixels in the views, but for a hundredth each."""
    order = torch.cat([view.depth[view.opacity > 0.5] for view in views]).sort().values
    if len(order) == 0:
        return 0.0, 1.0
    margin = (len(order) - 1) // 100
    near = float(order[margin])
    far = float(order[-1 - margin])
    return near, max(far, near + 1e-6)
