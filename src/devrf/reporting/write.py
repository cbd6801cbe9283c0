"""The report's files: collected, tabulated, plotted and written into one folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from devrf.errors import DevrfError
from devrf.reporting.csv_table import write_csv
from devrf.reporting.latex import latex
from devrf.reporting.markdown import markdown
from devrf.reporting.runs import collect
from devrf.reporting.table import PublishedScenes, Table, tabulate
from devrf.system.files import atomic_write

NO_PLOTS = 'No plots: matplotlib is not installed (pip install "devrf[plots]").'


@dataclass(frozen=True)
class ReportSettings:
    """What is reported.

    Attributes:
        runs: the folder below which finished runs are collected.
        into: the folder that the report is written to; None: ``report`` in ``runs``.
        published: which of the paper's own rows stand beside them: those of the scenes that
            were run, all, or none.
    """

    runs: str | Path = "outputs"
    into: str | Path | None = None
    published: PublishedScenes = "matching"

    @property
    def folder(self) -> Path:
        """Where the report is written."""
        return Path(self.runs) / "report" if self.into is None else Path(self.into)


@dataclass(frozen=True)
class Report:
    """A report that was written.

    Attributes:
        table: what it says.
        path: its ``report.md``; ``report.csv``, ``report.tex`` and ``figures/`` are beside it.
        remarks: what could not be done.
    """

    table: Table
    path: Path
    remarks: tuple[str, ...]


def write_report(settings: ReportSettings) -> Report:
    """Write ``report.md``, ``report.csv``, ``report.tex`` and the plots.

    Raises:
        DevrfError: no such folder, or nothing below it that a run left; nothing is written.
    """
    table = tabulate(collect(Path(settings.runs)), settings.published)
    found, folder = table.found, settings.folder
    if not found.runs and not found.failures:
        why = f" ({found.skipped[0]})" if found.skipped else ""
        raise DevrfError(
            f"report.runs: no finished run below {settings.runs}{why}; give the folder of runs "
            "that were scored (stage=pipeline or stage=evaluate)"
        )
    figures, remarks = _draw(table, folder)
    _write(folder / "report.md", markdown(table, figures, remarks))
    _write(folder / "report.tex", latex(table, remarks))
    write_csv(folder / "report.csv", table)
    return Report(table, folder / "report.md", remarks)


def _draw(table: Table, folder: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    """Plot what there is to plot: links by what they show, and what to say if nothing can be."""
    try:
        from devrf.reporting.plots import plots
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "matplotlib":
            raise
        return {}, (NO_PLOTS,)
    links: dict[str, str] = {}
    for plot in plots(table):
        for suffix in (".png", ".pdf"):
            with atomic_write(folder / "figures" / f"{plot.name}{suffix}") as partial:
                plot.figure.savefig(partial)
        links[plot.shows] = f"figures/{plot.name}.png"
    return links, ()


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")
