"""Plots of finished runs (matplotlib: ``pip install "devrf[plots]"``)."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import mean
from typing import Any

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from devrf.reporting.columns import COLUMNS, LPIPS, PSNR, SSIM, TIME, Column, cell
from devrf.reporting.rows import RowOfRuns
from devrf.reporting.table import Block, Table
from devrf.reporting.text import heading

# Okabe and Ito's, to be told apart by everyone.
COLORS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#8C6D31",
)
DASHES = ("-", "--", ":", "-.")
PUBLISHED = ", published"
INK, PALE = "#222222", "#9a9a9a"
STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "savefig.dpi": 160,
    "figure.facecolor": "white",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.6,
    "lines.markersize": 4,
}
# Marks of the paper's methods; what follows a name is a variant.
FAMILIES = {
    "DeVRF": "s",
    "D-NeRF": "^",
    "Nerfies": "v",
    "HyperNeRF": "D",
    "NSFF": "P",
    "Neural Volumes": "X",
}
VARIANT = r"-2 ?stage$|-dynamic$| \(base\)$| w/ .*$"
# Seconds to write on an axis, where it spans more than a factor of a hundred and where less.
FEW_TICKS = (1, 10, 60, 600, 3600, 36000, 360000)
TICKS = (
    1,
    2,
    5,
    10,
    20,
    30,
    60,
    120,
    300,
    600,
    1200,
    1800,
    3600,
    7200,
    18000,
    36000,
    86400,
    172800,
)


@dataclass(frozen=True)
class Plot:
    """A plot.

    Attributes:
        name: for its files.
        shows: what is in it, in words.
        figure: the plot itself.
    """

    name: str
    shows: str
    figure: Figure


def plots(table: Table) -> list[Plot]:
    """Every plot that there is something to show in."""
    scenes = dict.fromkeys(row.scene for row in table.rows)
    found = [
        ("psnr_against_seconds", "PSNR against training time", psnr_against_seconds(table)),
        ("metrics_against_views", "Metrics against dynamic training views", against_views(table)),
        *(
            (
                f"psnr_over_time_{_file(scene)}",
                f"{scene}: PSNR over time",
                psnr_over_time(table, scene),
            )
            for scene in scenes
        ),
    ]
    return [Plot(name, shows, figure) for name, shows, figure in found if figure is not None]


def psnr_over_time(table: Table, scene: str) -> Figure | None:
    """PSNR of the held-out images of one scene over time, a curve a row; the mean over seeds.

    None where no run has frames.
    """
    rows = [row for row in table.rows if row.scene == scene]
    curves = {row.label: curve for row in rows if (curve := _mean_curve(row))}
    if not curves:
        return None
    with _styled():
        figure = Figure(figsize=(6.4, 3.6), layout="constrained")
        axes = figure.subplots()
        for label, curve in curves.items():
            color, dashes = _look(table, label)
            marker = "o" if len(curve) < 30 else ""
            times, values = zip(*curve, strict=True)
            axes.plot(times, values, dashes, color=color, marker=marker, label=label)
        axes.set(title=scene, xlabel="time", ylabel=f"{PSNR.title} (dB)")
        _legend(figure, axes)
    return figure


def psnr_against_seconds(table: Table) -> Figure | None:
    """PSNR against training time, a panel a scene, the paper's rows as hollow marks.

    None where no run has both.
    """
    scenes = {row.scene for row in table.rows if _value(row, TIME) and _value(row, PSNR)}
    blocks = [block for block in table.blocks if block.title in scenes]
    if not blocks:
        return None
    across = min(3, len(blocks))
    down = -(-len(blocks) // across)
    with _styled():
        figure = Figure(figsize=(1.2 + 3.2 * across, 0.9 + 2.9 * down), layout="constrained")
        panels = figure.subplots(down, across, squeeze=False).flat
        for axes, block in zip(panels, blocks, strict=False):
            _points(axes, table, block)
        for axes in list(panels)[len(blocks) :]:
            axes.set_visible(False)
        _legend(figure, *figure.axes)
    return figure


def against_views(table: Table) -> Figure | None:
    """PSNR, and LPIPS or else SSIM, against the number of dynamic training views.

    A line for each scene and method. None unless some method was run with several numbers.
    """
    lines: dict[tuple[str, str], list[RowOfRuns]] = defaultdict(list)
    for row in table.rows:
        if row.views is not None:
            lines[row.scene, row.method].append(row)
    lines = {key: rows for key, rows in lines.items() if len({row.views for row in rows}) > 1}
    if not lines:
        return None
    methods = {method for _, method in lines}
    second = LPIPS if any(_value(r, LPIPS) for rows in lines.values() for r in rows) else SSIM
    with _styled():
        figure = Figure(figsize=(7.4, 3.4), layout="constrained")
        for axes, column in zip(figure.subplots(1, 2), (PSNR, second), strict=True):
            for k, ((scene, method), rows) in enumerate(lines.items()):
                known = sorted(
                    (row.views, value)
                    for row in rows
                    if row.views is not None and (value := _value(row, column)) is not None
                )
                label = scene if len(methods) == 1 else f"{scene}: {method}"
                color, dashes = _style(k)
                axes.plot(
                    [views for views, _ in known],
                    [value for _, value in known],
                    dashes,
                    color=color,
                    marker="o",
                    label=label,
                )
            axes.set(xlabel="dynamic training views", ylabel=heading(column))
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        _legend(figure, *figure.axes)
    return figure


def _points(axes: Axes, table: Table, block: Block) -> None:
    """One scene's panel."""
    for row in table.rows:
        seconds, psnr = _value(row, TIME), _value(row, PSNR)
        if row.scene == block.title and seconds and psnr is not None:
            color, _ = _look(table, row.label)
            axes.plot(seconds, psnr, "o", color=color, markersize=6, label=row.label)
    for published in block.published:
        method = re.sub(VARIANT, "", published.label)
        seconds, psnr = (published.cells[COLUMNS.index(column)].value for column in (TIME, PSNR))
        if seconds and psnr is not None:
            axes.plot(
                seconds,
                psnr,
                FAMILIES.get(method, "o"),
                color=PALE,
                markerfacecolor="none",
                label=f"{method}{PUBLISHED}",
            )
    axes.set(title=block.title, xscale="log", xlabel="training time", ylabel=f"{PSNR.title} (dB)")
    low, high = axes.get_xlim()
    low, high = low / 1.5, high * 1.5
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(FixedLocator(FEW_TICKS if high > 100 * low else TICKS))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(_time))


def _time(seconds: float, position: int | None = None) -> str:
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{seconds / size:g} {unit}"
    return f"{seconds:g} s"


def _value(row: RowOfRuns, column: Column) -> float | None:
    return cell([column.of(run) for run in row.runs], column).value


def _mean_curve(row: RowOfRuns) -> list[tuple[float, float]]:
    """(time, PSNR), where all seeds of a row have the time."""
    curves = [dict(run.over_time("psnr")) for run in row.runs]
    shared = sorted(set.intersection(*(set(curve) for curve in curves)))
    return [(time, mean(curve[time] for curve in curves)) for time in shared]


def _look(table: Table, label: str) -> tuple[str, str]:
    """Colour and dashes of a row, the same in all plots of a report."""
    return _style(list(dict.fromkeys(row.label for row in table.rows)).index(label))


def _style(k: int) -> tuple[str, str]:
    return COLORS[k % len(COLORS)], DASHES[k // len(COLORS) % len(DASHES)]


def _legend(figure: Figure, *panels: Axes) -> None:
    """One legend below the figure for all its panels: each label once, ours first."""
    handles: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    handles = dict(sorted(handles.items(), key=lambda entry: entry[0].endswith(PUBLISHED)))
    longest = max(map(len, handles))
    columns = max(1, min(len(handles), int(figure.get_figwidth() * 16 / (longest + 6))))
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=columns)


def _file(scene: str) -> str:
    return re.sub(r"[^\w.-]+", "_", scene)


@contextmanager
def _styled() -> Iterator[None]:
    with mpl.rc_context(STYLE):
        yield
