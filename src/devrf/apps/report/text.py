"""A report as Markdown, as LaTeX and as plain text."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from devrf.apps.report.runs import Collection
from devrf.apps.report.table import Block, Table, published
from devrf.system import printed


class Style(NamedTuple):
    """A format of text: an escape, cells that are unmarked, best, second and third, and tables.

    ``form`` is the table's name for tabulate.
    """

    escape: Callable[[str], str]
    marks: tuple[str, str, str, str]
    form: str

    def table(self, block: Block) -> str:
        """A block as text."""
        cells = block.cells.map(lambda cell: self.marks[cell.rank].format(self.escape(cell.text)))
        cells = cells.rename(index=self.escape, columns=self.escape)
        align = ["left"] + ["right"] * len(cells.columns)
        return str(cells.to_markdown(tablefmt=self.form, disable_numparse=True, colalign=align))


MARKDOWN = Style(printed.markdown, ("{}", "**{}**", "<ins>{}</ins>", "*{}*"), "pipe")
PLAIN = Style(str, ("{} ", "{}¹", "{}²", "{}³"), "simple")
LATEX = Style(
    printed.latex, ("{}", r"\textbf{{{}}}", r"\underline{{{}}}", r"\textit{{{}}}"), "latex_raw"
)


def caption(table: Table) -> str:
    """The meaning of the numbers, and of their marks."""
    devices = table.runs["run.device"].dropna().unique()
    where = f" on {', '.join(devices)}" if len(devices) else ""
    repeated = bool((table.rows["count"] > 1).any())
    spread = " ± is the standard deviation over n runs." * repeated
    # Of a scene whose runs all follow it.
    others = table.runs.loc[table.runs["run.benchmark"].isna(), "scene"]
    following = table.runs[~table.runs["scene"].isin(others)]
    scenes_of = following.groupby("run.benchmark", sort=False)["scene"].unique()
    benchmarks = "".join(
        f" Benchmark {name}: {', '.join(scenes)}." for name, scenes in scenes_of.items()
    )
    paper = f" † {published().credit}" if table.published else ""
    return (
        f"Measured{where}: means over the held-out images in motion, of a scene at rest over those "
        f"of the static set; peak GPU memory and wall-clock time of optimisation, all stages "
        f"together.{spread} Best, second and third are marked within a scene, among measured rows; "
        f"values that look the same share a mark.{benchmarks}{paper}"
    )


def reasons(collection: Collection) -> list[str]:
    """The failed runs, by their folders, and why they failed, a line each."""
    lines: list[str] = []
    for failure in collection.failures.to_dict("records"):
        bug = " (a fault of the program: see its run.log)" * (failure["mistake"] is False)
        lines.append(f"{failure['folder']}: {failure['error']}{bug}")
    return lines


def markdown(table: Table, links: Mapping[str, str]) -> str:
    """The whole report, with ``links`` to pictures and videos, by their captions."""
    escape = printed.markdown
    collection = table.collection
    failed = f", {len(collection.failures)} failed" if len(collection.failures) else ""
    count = len(collection.runs)
    parts = [
        "# Runs compared",
        f"{count} finished run{'s' * (count != 1)} below `{collection.folder}`{failed}.",
        f"{escape(caption(table))} **Best**, <ins>second</ins>, *third*.",
    ]
    for block in table.blocks:
        parts += [f"## {escape(block.title)}", MARKDOWN.table(block)]
    for heading, lines in (
        ("", table.notes),
        ("## Failed", reasons(collection)),
        ("## Skipped", collection.skipped),
    ):
        if lines:
            parts += [heading, "\n".join(f"- {escape(line)}" for line in lines)]
    if links:
        parts.append("## Plots and videos")
    for shows, link in links.items():
        parts.append(f"{'!' * link.endswith('.png')}[{escape(shows)}](<{link}>)")
    return "\n\n".join(filter(None, parts)) + "\n"


def plain(table: Table) -> str:
    """The tables, notes and failures, for a terminal; ¹ ² ³ mark the best."""
    blocks = [f"{block.title}\n{PLAIN.table(block)}\n" for block in table.blocks]
    failed = [f"failed: {why}" for why in reasons(table.collection)]
    return "\n".join([*blocks, *table.notes, *failed, *table.collection.skipped])


def latex(table: Table) -> str:
    """A table a scene, for a paper to input; it prints no notes and failures: comments.

    A table that is wider than the page is made smaller, by the package graphicx.
    """
    parts = []
    fitted = "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}"
    words = caption(table)
    for block in table.blocks:
        title = printed.latex(f"{block.title}. {words}")
        parts.append(
            "\\begin{table}[t]\n\\centering\n\\scriptsize\n"
            f"\\caption{{{title}}}\n{fitted}{{%\n{LATEX.table(block)}}}\n\\end{{table}}\n\n"
        )
        words = "As above."
    lines = [*table.notes, *(f"failed: {why}" for why in reasons(table.collection))]
    return "".join([*parts, *(f"% {' '.join(line.split())}\n" for line in lines)])
