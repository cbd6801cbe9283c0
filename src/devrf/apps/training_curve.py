"""A stage's PSNR while it learns, as a plot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure

from devrf.system.files import atomic_write

BATCHES, MEAN, PREVIEWS = "#9ec9e6", "#0072b2", "#d55e00"
STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "legend.frameon": False,
}
# The running mean is over so large a part of the curve; more labels of grids would overlap.
WINDOW, MOST_GRIDS = 1 / 25, 8


def write_training_curve(
    path: Path,
    stage: str,
    batches: Sequence[tuple[int, float]],
    previews: Sequence[tuple[int, float]] = (),
    grids: Sequence[tuple[int, str]] = (),
) -> None:
    """Write the plot as a PNG; see :func:`training_curve`."""
    figure = training_curve(stage, batches, previews, grids)
    with atomic_write(path) as partial:
        figure.savefig(partial, format="png", dpi="figure")


@mpl.rc_context(STYLE)
def training_curve(
    stage: str,
    batches: Sequence[tuple[int, float]],
    previews: Sequence[tuple[int, float]] = (),
    grids: Sequence[tuple[int, str]] = (),
) -> Figure:
    """The plot of (iteration, PSNR in dB) of training batches.

    Args:
        stage: its name.
        batches: of each step, ascending, at least one.
        previews: the same of a held-out view; may be empty.
        grids: iterations at which the grid took another size, and that size.
    """
    figure = Figure(figsize=(8.0, 4.2), dpi=120, layout="constrained")
    axes = figure.subplots()
    curve = pd.Series(dict(batches), dtype=float)
    mean = curve.rolling(max(1, round(WINDOW * len(curve))), min_periods=1).mean()
    axes.plot(curve.index, curve, color=BATCHES, linewidth=0.9, label="batches")
    axes.plot(mean.index, mean, color=MEAN, linewidth=1.8, label="running mean")
    if previews:
        axes.plot(*zip(*previews, strict=True), "o", color=PREVIEWS, label="held-out preview")
    if 1 < len(grids) <= MOST_GRIDS:
        for iteration, shape in grids:
            axes.axvline(iteration, color="0.75", linewidth=0.8, linestyle=":")
            place: dict[str, Any] = {"xytext": (3, 2), "textcoords": "offset points"}
            at = (iteration, 1), ("data", "axes fraction")
            axes.annotate(shape, at[0], xycoords=at[1], fontsize=8, color="0.4", **place)
    axes.set(xlabel="iteration", ylabel="PSNR (dB)")
    axes.set_title(f"{stage}: PSNR of the training batches", loc="left", pad=20)
    figure.legend(loc="outside lower center", ncols=3)
    return figure
