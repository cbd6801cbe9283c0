"""The report's files: collected, tabulated, plotted, filmed and written into one folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from devrf.apps.report.film import scene_film
from devrf.apps.report.latex import latex
from devrf.apps.report.markdown import markdown, plain
from devrf.apps.report.plots import file_name, plots
from devrf.apps.report.runs import collect
from devrf.apps.report.settings import ReportSettings
from devrf.apps.report.table import Table, tabulate
from devrf.apps.video_file import write_pictures
from devrf.errors import DevrfError
from devrf.system.files import atomic_write

# Pictures a second of the videos that show rows side by side.
FPS = 10


@dataclass(frozen=True)
class Report:
    """A written report: its contents, its text for a terminal, and its ``report.md``."""

    table: Table
    text: str
    path: Path


def write_report(settings: ReportSettings) -> Report:
    """Write ``report.md``, ``report.csv``, ``report.tex``, the plots and the videos.

    Raises:
        DevrfError: no such folder, or nothing below it that a run left; nothing is written.
    """
    found, folder = collect(Path(settings.runs)), settings.folder
    if found.runs.empty and found.failures.empty:
        why = f" ({found.skipped[0]})" if found.skipped else ""
        raise DevrfError(
            f"report.runs: no finished run below {settings.runs}{why}; give the folder of runs "
            "that were scored (stage=pipeline or stage=evaluate)"
        )
    table = tabulate(found, settings.published)
    figures, films = _write_plots(table, folder), _write_films(table, folder)
    _write(folder / "report.md", markdown(table, figures, films))
    _write(folder / "report.tex", latex(table))
    _write(folder / "report.csv", csv(table))
    return Report(table, plain(table), folder / "report.md")


def csv(table: Table) -> str:
    """A row for each run and failure, with everything that is known of it.

    ``train_seconds`` and ``peak_gpu_gb`` are the tables' Time and GPU; further columns are those
    of ``metrics.json``, by dotted name. Unknown values are empty.
    """
    runs = table.found.runs.drop(columns="path").copy()  # in one piece
    runs.insert(3, "row", table.runs["label"])
    failures = table.found.failures.drop(columns="path")
    rows = pd.concat([runs, failures], ignore_index=True)
    return str(rows.map(_csv_cell).to_csv(index=False, lineterminator="\n"))


def _csv_cell(value: object) -> str:
    """Text as it was recorded: a column of integers stays one where some are unknown."""
    if isinstance(value, list):
        return " ".join(map(str, value))
    if isinstance(value, bool):
        return str(value).lower()
    return "" if pd.isna(value) else str(value)


def _write_plots(table: Table, folder: Path) -> dict[str, str]:
    """Write the plots as PNG and PDF; returns links to the former, by what they show."""
    links: dict[str, str] = {}
    for plot in plots(table):
        for suffix in (".png", ".pdf"):
            with atomic_write(folder / "figures" / f"{plot.name}{suffix}") as partial:
                plot.figure.savefig(partial)
        links[plot.shows] = f"figures/{plot.name}.png"
    return links


def _write_films(table: Table, folder: Path) -> dict[str, str]:
    """Write a video of all rows for each scene that has several; links as of the plots."""
    links: dict[str, str] = {}
    for scene in table.runs["scene"].unique():
        pictures = scene_film(table, scene)
        if pictures is not None:
            name = f"{file_name(f'side_by_side_{scene}')}.mp4"
            write_pictures(folder / "videos" / name, pictures, FPS)
            links[f"{scene}: truth and renderings side by side"] = f"videos/{name}"
    return links


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")
