"""A contact sheet of held-out views: truth, rendering, error and depth, with labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from devrf.apps.colors import depth_colors, error_colors
from devrf.apps.grid import image_grid, scaled
from devrf.apps.images import evenly, short_name, write_image
from devrf.evaluation.held_out import HeldOutView

# Lower images are enlarged to this height, higher ones reduced to the other, in pixels.
LEAST_HEIGHT, MOST_HEIGHT = 300, 640
HEADINGS = ("truth", "rendered", "error: 0 to 0.25 or more", "depth: near is bright")


def write_contact_sheet(path: Path, views: Sequence[HeldOutView], rows: int = 6) -> Tensor:
    """Write a PNG with ``rows`` of the views, evenly spread, each with name, time and scores.

    Returns:
        The sheet (H, W, 3) in [0, 1].
    """
    shown = [views[k] for k in evenly(len(views), rows)]
    near, far = _depth_range(shown)
    tiles = [
        (
            view.truth,
            view.prediction,
            error_colors(view.compared, view.truth),
            depth_colors(view.depth, view.opacity, near, far),
        )
        for view in shown
    ]
    height = min(max(shown[0].truth.shape[0], LEAST_HEIGHT), MOST_HEIGHT)
    sheet = image_grid(
        [[scaled(tile, height) for tile in row] for row in tiles],
        HEADINGS,
        [_label(view) for view in shown],
    )
    write_image(path, sheet)
    return sheet


def _label(view: HeldOutView) -> tuple[str, ...]:
    scores = (f"PSNR {view.psnr:.2f} dB", f"SSIM {view.ssim:.3f}")
    return (*_broken(short_name(view.name)), f"time {view.time:.2f}", *scores)


def _broken(name: str) -> list[str]:
    """A name in lines of about 16 characters, broken at its spaces."""
    lines = [""]
    for word in name.split():
        fits = len(lines[-1]) + len(word) < 16
        lines = [*lines[:-1], f"{lines[-1]} {word}".strip()] if fits else [*lines, word]
    return [line for line in lines if line]


def _depth_range(views: Sequence[HeldOutView]) -> tuple[float, float]:
    """The nearest and furthest depth of what is solid in the views, but for a hundredth each."""
    depth = torch.cat([view.depth[view.opacity > 0.5] for view in views])
    if len(depth) == 0:
        return 0.0, 1.0
    order = depth.sort().values
    last = len(order) - 1
    near, far = float(order[last // 100]), float(order[last - last // 100])
    return near, max(far, near + 1e-6)
