"""Figures: their style, and as files."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from devrf.system.files import atomic_write

STYLE: dict[Any, Any] = {
    "figure.dpi": 160,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.formatter.useoffset": False,
    "text.parse_math": False,  # a name may hold $
    "grid.color": "#e6e6e6",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.handlelength": 2.6,  # of two dashes
    "lines.linewidth": 1.6,
    "lines.markersize": 4,
}


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure in the format of the path's suffix; letters that its font lacks are boxes."""
    with atomic_write(path) as partial, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Glyph \d+ .* missing from")
        # A side of 2**16 pixels is too long for matplotlib.
        figure.savefig(partial, dpi=min(figure.dpi, 20_000 / max(figure.get_size_inches())))
