"""Plots of finished runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from textwrap import fill
from typing import NamedTuple

import matplotlib as mpl
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, MaxNLocator, NullFormatter, ScalarFormatter

from devrf.apps.report.labels import METHODS
from devrf.apps.report.runs import metric_over_time
from devrf.apps.report.table import LPIPS, PSNR, SSIM, TIME, Column, Table, published
from devrf.pictures.figures import STYLE

# The palette of Okabe and Ito, distinguishable with colour-blindness; other dashes, or points, each
# eight rows.
COLORS = "#0072B2 #D55E00 #009E73 #CC79A7 #E69F00 #56B4E9 #000000 #8C6D31".split()
DASHES = ("-", "--", ":", "-.")
POINTS = "osD^"
# Inches of a line of the legend: the figure grows by it, so that curves keep their room. Letters in
# a line: no more are as wide as a panel.
LEGEND_LINE = 0.19
LEGEND_WIDTH = 60
PUBLISHED = ", published"
GREY = "#9a9a9a"
# Markers of the methods, and the endings of their variants' names.
NAMES = ("DeVRF", *list(METHODS.values())[1:])
MARKERS = dict(zip(NAMES, "s^vDPXo*h", strict=True))
VARIANT = r"-2 ?stage$|-dynamic$| \(base\)$| w/ .*$"
SECONDS = "training time (s)"
VIEWS = r"; data\.train_views=\d+"


class Plot(NamedTuple):
    """A plot, the name of its files, and its caption."""

    name: str
    shows: str
    figure: Figure


@mpl.rc_context(STYLE)
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
    drawn = [Plot(name, shows, figure) for name, shows, figure in candidates if figure is not None]
    for plot in drawn:
        _legend(plot.figure)
    return drawn


def file_name(text: str) -> str:
    """Text as the name of a file, without characters that a file system or a link may refuse."""
    return re.sub(r"[^\w.-]+", "_", text).encode()[:200].decode(errors="ignore")


def psnr_over_time(table: Table, scene: str) -> Figure | None:
    """PSNR of one scene's held-out images over time, a mean curve a row; None without frames."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    rows = table.runs[table.runs["scene"] == scene].groupby(["label", "identity"], sort=False)
    for (label, _), runs in rows:
        curves = [metric_over_time(path, "psnr") for path in runs["path"]]
        curve = pd.concat(curves, axis=1, join="inner").mean(axis=1)
        if len(curve):
            color, dashes = _look(table, label)
            marker = "o" if len(curve) < 30 else ""
            axes.plot(curve.index, curve, dashes, color=color, marker=marker, label=label)
    if not axes.has_data():
        return None
    axes.set(title=scene, xlabel="time", ylabel=f"{PSNR.title} (dB)")
    return figure


def psnr_against_seconds(table: Table) -> Figure | None:
    """PSNR against training time, a panel a scene, the paper's rows hollow; None without both.

    Scenes that were learned in a budget of seconds are left out (:func:`against_budget`).
    """
    limited = table.runs.loc[table.runs["budget"].notna(), "scene"].unique()
    rows = _seconds_and_psnr(table.rows.drop(limited, level="scene", errors="ignore"))
    scenes = rows.index.unique("scene")
    if rows.empty:
        return None
    across = min(3, len(scenes))
    down = -(-len(scenes) // across)
    figure = Figure(figsize=(1.2 + 3.2 * across, 0.9 + 2.9 * down), layout="constrained")
    for k, scene in enumerate(scenes):
        axes = figure.add_subplot(down, across, k + 1)
        for label, seconds, psnr in rows.loc[scene].itertuples(name=None):
            color, dashes = _look(table, label)
            mark = POINTS[DASHES.index(dashes)]
            axes.plot(seconds, psnr, mark, color=color, markersize=6, label=label)
        paper = _seconds_and_psnr(
            published().values.loc[[scene] if scene in table.published else []]
        )
        for (_, label), seconds, psnr in paper.itertuples(name=None):
            method = re.sub(VARIANT, "", label)
            (point,) = axes.plot(seconds, psnr, MARKERS[method], label=f"{method}{PUBLISHED}")
            point.set(color=GREY, markerfacecolor="none")
        axes.set(title=scene, xscale="log", xlabel=SECONDS, ylabel=f"{PSNR.title} (dB)")
        axes.xaxis.set_major_formatter(LogFormatter())
        axes.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))
    return figure


def against_budget(table: Table, place: str) -> Figure | None:
    """PSNR, SSIM and LPIPS of a scene against budgets of seconds; None unless there are several."""
    runs = table.runs[table.runs["place"] == place].dropna(subset="budget")
    budgets = sorted(runs["budget"].unique())
    if len(budgets) < 2:
        return None
    columns = [column for column in (PSNR, SSIM, LPIPS) if runs[column.title].notna().any()]
    figure = _panels(runs, "label", "budget", columns, list(table.runs["label"].unique()))
    for axes in figure.axes:
        axes.set(title=place, xscale="log", xlabel=SECONDS, xticks=budgets)
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
    return figure


def against_views(table: Table) -> Figure | None:
    """PSNR, and LPIPS or else SSIM, against the number of dynamic training views.

    Each scene and configuration has a line. None unless one was run with several numbers.
    """
    runs = table.runs.dropna(subset="views")
    # A row's name but for the number of views, where it was typed.
    runs = runs.assign(line=[re.sub(VIEWS, "", label) for label in runs["label"]])
    runs = runs.groupby(["scene", "line"]).filter(lambda line: line["views"].nunique() > 1)
    if runs.empty:
        return None
    if runs["line"].nunique() == 1:
        runs["line"] = runs["scene"]
    else:
        runs["line"] = runs["scene"] + ": " + runs["line"]
    second = LPIPS if runs[LPIPS.title].notna().any() else SSIM
    figure = _panels(runs, "line", "views", [PSNR, second], list(runs["line"].unique()))
    for axes in figure.axes:
        axes.set(xlabel="dynamic training views")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _panels(
    runs: pd.DataFrame, line: str, x: str, columns: Sequence[Column], lines: Sequence[str]
) -> Figure:
    """A panel for each column, with means over runs, and standard deviations, by ``x``.

    The values of ``line``, in the order of ``lines``, have a line each.
    """
    figure = Figure(figsize=(0.8 + 3.3 * len(columns), 4.0), layout="constrained")
    panels = figure.subplots(1, len(columns), squeeze=False)[0]
    for axes, column in zip(panels, columns, strict=True):
        for name, group in runs.dropna(subset=column.title).groupby(line, sort=False):
            values = group.groupby(x)[column.title].agg(["mean", "std"]).fillna({"std": 0})
            color, dashes = _style(lines.index(str(name)))
            look = {"color": color, "linestyle": dashes, "marker": "o", "capsize": 2}
            axes.errorbar(values.index, values["mean"], values["std"], label=name, **look)
        axes.set_ylabel(column.heading)
    return figure


def _seconds_and_psnr(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of which both are known and the time is above 0."""
    return rows.loc[rows[TIME.title] > 0, [TIME.title, PSNR.title]].dropna()


def _look(table: Table, label: str) -> tuple[str, str]:
    """Colour and dashes of a row, the same in all plots of a report."""
    return _style(list(table.runs["label"].unique()).index(label))


def _style(k: int) -> tuple[str, str]:
    return COLORS[k % len(COLORS)], DASHES[k // len(COLORS) % len(DASHES)]


def _legend(figure: Figure) -> None:
    """One legend for all panels, ours first; the figure grows by its lines."""
    handles: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    names = sorted(handles, key=lambda label: label.endswith(PUBLISHED))
    texts = [fill(name, LEGEND_WIDTH) for name in names]
    figure.legend([handles[name] for name in names], texts, loc="outside lower center")
    lines = "\n".join(texts).count("\n")
    figure.set_figheight(figure.get_figheight() + lines * LEGEND_LINE)
