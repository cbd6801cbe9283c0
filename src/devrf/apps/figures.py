"""Figures as files."""

from __future__ import annotations

import warnings
from pathlib import Path

from matplotlib.figure import Figure

from devrf.system.files import atomic_write


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure in the format of the path's suffix; letters that its font lacks are boxes."""
    with atomic_write(path) as partial, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Glyph \d+ .* missing from")
        # For matplotlib a side of 2**16 pixels is too long.
        figure.savefig(partial, dpi=min(figure.dpi, 20_000 / max(figure.get_size_inches())))
