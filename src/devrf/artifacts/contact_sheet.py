"""A contact sheet: prediction | truth | error of some held-out views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from devrf.artifacts.colors import error_colors
from devrf.artifacts.images import write_image
from devrf.evaluation.held_out import HeldOutView

GAP = 4


def write_contact_sheet(path: Path, views: Sequence[HeldOutView], rows: int = 6) -> Tensor:
    """Write a PNG with ``rows`` of the views, evenly spread: prediction | truth | error.

    Returns:
        The sheet (H, W, 3) in [0, 1].
    """
    count = min(rows, len(views))
    chosen = [views[round(k * (len(views) - 1) / max(count - 1, 1))] for k in range(count)]
    strips = [
        side_by_side([v.prediction, v.truth, error_colors(v.compared, v.truth)]) for v in chosen
    ]
    sheet = side_by_side([strip.transpose(0, 1) for strip in strips]).transpose(0, 1)
    write_image(path, sheet)
    return sheet


def side_by_side(images: Sequence[Tensor], gap: int = GAP) -> Tensor:
    """Images (H, W, 3) of one height in a row, with white between them."""
    white = torch.ones(images[0].shape[0], gap, 3)
    parts: list[Tensor] = []
    for image in images:
        parts += [white, image] if parts else [image]
    return torch.cat(parts, dim=1)
