"""Plots of finished runs, and of a stage while it learns."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import NamedTuple

import matplotlib as mpl
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

from devrf.apps.report.labels import METHODS
from devrf.apps.report.runs import DEFAULT_METHOD, metric_over_time
from devrf.apps.report.table import LPIPS, PSNR, SSIM, TIME, Block, Table
from devrf.pictures.figures import STYLE

# The palette of Okabe and Ito, distinguishable with colour-blindness; then each time the colour
# furthest in CIELAB from those before, from white and from grey. Other dashes every eight colours.
COLORS = (
    "#0072B2 #D55E00 #009E73 #CC79A7 #E69F00 #56B4E9 #000000 #8C6D31 "
    "#4B0096 #96D21E #FF0069 #69001E #D200A5 #A587FF #0F3C00 #4B1E5A "
    "#00E178 #FFB496 #B4C369 #1E870F #D25A5A #006969 #5AD2D2 #D2001E"
).split()
DASHES = ("-", "--", ":", "-.")
ALIKE = 8
POINTS = "osD^"
# Inches of a line of the legend: the figure grows by it, so that curves keep their room.
LEGEND_LINE = 0.19
MOST_COLUMNS = 8
PUBLISHED = ", published"
GREY = "#9a9a9a"
# Markers of the methods, and the endings of their variants' names.
NAMES = ("DeVRF", *list(METHODS.values())[1:])
MARKERS = dict(zip(NAMES, "s^vDPXo*", strict=True))
VARIANT = r"-2 ?stage$|-dynamic$| \(base\)$| w/ .*$"
# Seconds to label on an axis: the first of these multiples for which there is room.
UNITS = (0.01, 0.1, 1, 10, 60, 600, 3600, 36000, 360000, math.inf)
MULTIPLES = ((1, 1.5, 2, 3, 4, 6), (1, 2, 3, 4, 6), (1, 2, 5), (1, 3), (1,))
MOST_TICKS = 5


class Plot(NamedTuple):
    """A plot, the name of its files, and its caption."""

    name: str
    shows: str
    figure: Figure


def plots(table: Table) -> list[Plot]:
    """Every plot that has data."""
    candidates = [
        ("psnr_against_seconds", "PSNR against training time", psnr_against_seconds(table)),
        ("metrics_against_views", "Metrics against dynamic training views", against_views(table)),
    ]
    for place in table.runs["place"].unique():
        name = file_name(f"quality_against_seconds_{place}")
        candidates.append((name, f"{place}: quality against seconds", against_budget(table, place)))
    for scene in table.runs.loc[table.runs["budget"].isna(), "scene"].unique():
        name = file_name(f"psnr_over_time_{scene}")
        candidates.append((name, f"{scene}: PSNR over time", psnr_over_time(table, scene)))
    return [Plot(name, shows, figure) for name, shows, figure in candidates if figure is not None]


def file_name(text: str) -> str:
    """Text as the name of a file, without characters that a file system or a link may refuse."""
    return re.sub(r"[^\w.-]+", "_", text).encode()[:200].decode(errors="ignore")


@mpl.rc_context(STYLE)
def psnr_over_time(table: Table, scene: str) -> Figure | None:
    """PSNR of one scene's held-out images over time, a mean curve a row; None without frames."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for label, runs in table.runs[table.runs["scene"] == scene].groupby("label", sort=False):
        curves = [metric_over_time(path, "psnr") for path in runs["path"]]
        curve = pd.concat(curves, axis=1, join="inner").mean(axis=1)
        if len(curve):
            color, dashes = _look(table, label)
            marker = "o" if len(curve) < 30 else ""
            axes.plot(curve.index, curve, dashes, color=color, marker=marker, label=label)
    if not axes.has_data():
        return None
    axes.set(title=scene, xlabel="time", ylabel=f"{PSNR.title} (dB)")
    _legend(figure)
    return figure


@mpl.rc_context(STYLE)
def psnr_against_seconds(table: Table) -> Figure | None:
    """PSNR against training time, a panel a scene, the paper's rows hollow; None without both.

    Scenes that were learned in a budget of seconds are left out (:func:`against_budget`).
    """
    both = table.rows[(table.rows[TIME.title] > 0) & table.rows[PSNR.title].notna()]
    limited = table.runs.loc[table.runs["budget"].notna(), "scene"]
    scenes = both.index.get_level_values("scene").difference(limited)
    blocks = [block for block in table.blocks if block.title in scenes]
    if not blocks:
        return None
    across = min(3, len(blocks))
    down = -(-len(blocks) // across)
    figure = Figure(figsize=(1.2 + 3.2 * across, 0.9 + 2.9 * down), layout="constrained")
    panels = list(figure.subplots(down, across, squeeze=False).flat)
    for axes, block in zip(panels, blocks, strict=False):
        _points(axes, table, block)
    for axes in panels[len(blocks) :]:
        axes.remove()
    _legend(figure)
    return figure


@mpl.rc_context(STYLE)
def against_budget(table: Table, place: str) -> Figure | None:
    """PSNR, SSIM and LPIPS of a scene against budgets of seconds, a panel each.

    Each row has a line, with the standard deviation over its runs: methods have colours, their
    variants dashes. None unless there are several budgets.
    """
    runs = table.runs[table.runs["place"] == place].dropna(subset="budget")
    budgets = sorted(runs["budget"].unique())
    if len(budgets) < 2:
        return None
    columns = [column for column in (PSNR, SSIM, LPIPS) if runs[column.title].notna().any()]
    figure = Figure(figsize=(0.8 + 3.3 * len(columns), 4.0), layout="constrained")
    methods = list(runs["method"].unique())
    labels = runs.groupby("method")["label"].unique()
    for axes, column in zip(
        figure.subplots(1, len(columns), squeeze=False)[0], columns, strict=True
    ):
        for (method, label), row in runs.groupby(["method", "label"], sort=False):
            values = row.groupby("budget")[column.title]
            means = values.mean()
            spread = values.std().fillna(0.0)
            dashes = DASHES[list(labels[method]).index(label) % len(DASHES)]
            axes.errorbar(
                means.index,
                means,
                spread,
                color=COLORS[methods.index(method)],
                linestyle=dashes,
                linewidth=2.8 if method == DEFAULT_METHOD else 1.4,
                marker="o",
                capsize=2,
                label=label,
            )
        axes.set(title=place, xscale="log", xlabel="training time", ylabel=column.heading)
        axes.xaxis.set_major_locator(FixedLocator(budgets))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(_time)
    _legend(figure)
    return figure


@mpl.rc_context(STYLE)
def against_views(table: Table) -> Figure | None:
    """PSNR, and LPIPS or else SSIM, against the number of dynamic training views.

    Each scene and configuration has a line. None unless one was run with several numbers.
    """
    rows = table.rows.dropna(subset="views").sort_values("views")
    lines = rows.groupby(["scene", "line"], sort=False).filter(lambda g: g["views"].nunique() > 1)
    if lines.empty:
        return None
    one_line = lines["line"].nunique() == 1
    second = LPIPS if lines[LPIPS.title].notna().any() else SSIM
    figure = Figure(figsize=(7.4, 3.4), layout="constrained")
    for axes, column in zip(figure.subplots(1, 2), (PSNR, second), strict=True):
        for k, ((scene, line), group) in enumerate(lines.groupby(["scene", "line"], sort=False)):
            color, dashes = _style(k)
            rows = group.dropna(subset=column.title)
            label = scene if one_line else f"{scene}: {line}"
            axes.plot(
                rows["views"], rows[column.title], dashes, color=color, marker="o", label=label
            )
        axes.set(xlabel="dynamic training views", ylabel=column.heading)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _legend(figure)
    return figure


def _points(axes: Axes, table: Table, block: Block) -> None:
    """One scene's panel."""
    for label, seconds, psnr in _seconds_and_psnr(block.measured):
        color, dashes = _look(table, label)
        mark = POINTS[DASHES.index(dashes)]
        axes.plot(seconds, psnr, mark, color=color, markersize=6, label=label)
    for label, seconds, psnr in _seconds_and_psnr(block.published):
        method = re.sub(VARIANT, "", label)
        axes.plot(
            seconds,
            psnr,
            MARKERS[method],
            color=GREY,
            markerfacecolor="none",
            label=f"{method}{PUBLISHED}",
        )
    axes.set(title=block.title, xscale="log", xlabel="training time", ylabel=f"{PSNR.title} (dB)")
    low, high = axes.get_xlim()
    low, high = axes.set_xlim(low / 1.5, high * 1.5)
    axes.xaxis.set_major_locator(FixedLocator(_ticks(low, high)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(_time)


def _seconds_and_psnr(rows: pd.DataFrame) -> list[tuple[str, float, float]]:
    """(label, seconds, PSNR) if both are known and the time is above 0."""
    scores = rows["value"][[TIME.title, PSNR.title]].dropna()
    return list(scores[scores[TIME.title] > 0].itertuples(name=None))


def _ticks(low: float, high: float) -> list[float]:
    """Round times in seconds between two times."""
    for multiples in MULTIPLES:
        # No 50 s beside 1 min.
        times = [m * u for u, above in pairwise(UNITS) for m in multiples if 1.5 * m * u <= above]
        ticks = [time for time in times if low <= time <= high]
        if len(ticks) <= MOST_TICKS:
            break
    return ticks


def _time(seconds: float, position: float) -> str:
    """The label of a tick."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{seconds / size:g} {unit}"
    return f"{seconds:g} s"


def _look(table: Table, label: str) -> tuple[str, str]:
    """Colour and dashes of a row, the same in all plots of a report."""
    return _style(list(table.runs["label"].unique()).index(label))


def _style(k: int) -> tuple[str, str]:
    return COLORS[k % len(COLORS)], DASHES[k // ALIKE % len(DASHES)]


def _legend(figure: Figure) -> None:
    """One legend for all panels, ours first; the figure grows by it, so that nothing is cut off."""
    handles: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    handles = dict(sorted(handles.items(), key=lambda entry: entry[0].endswith(PUBLISHED)))
    for columns in range(min(len(handles), MOST_COLUMNS), 0, -1):
        legend = figure.legend(
            list(handles.values()), list(handles), loc="outside lower center", ncols=columns
        )
        needed = legend.get_window_extent().width / figure.dpi
        if needed <= figure.get_figwidth() or columns == 1:
            figure.set_figwidth(max(needed, figure.get_figwidth()))
            lines = -(-len(handles) // columns)
            figure.set_figheight(figure.get_figheight() + (lines - 1) * LEGEND_LINE)
            return
        legend.remove()
