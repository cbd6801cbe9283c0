"""A report as Markdown, as LaTeX and as plain text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from devrf.apps.report.runs import Collection
from devrf.apps.report.table import Block, Column, Table, published
from devrf.system import printed


@dataclass(frozen=True)
class Style:
    """Forms of a format: of text, of an unmarked, best, second and third cell, and of a heading."""

    escape: Callable[[str], str]
    marks: tuple[str, str, str, str]
    heading: str = "{}"


def cells_of(table: Table, blocks: Sequence[Block], style: Style) -> pd.DataFrame:
    """Blocks side by side as text: measured rows, then published ones below a line of their own.

    Columns have two levels: the label, and the protocol where it differs, below an empty title;
    then each block's title with every metric's heading below it.
    """
    parts = [_rows(table, blocks, [block.measured for block in blocks], style, "{}")]
    if any(len(block.published) for block in blocks):
        line = style.heading.format(style.escape(f"† published, on an {published().hardware}"))
        parts.append(pd.DataFrame([[line]], columns=parts[0].columns[:1]))
        parts.append(_rows(table, blocks, [block.published for block in blocks], style, "† {}"))
    return pd.concat(parts, ignore_index=True).fillna("")


def _rows(
    table: Table, blocks: Sequence[Block], frames: Sequence[pd.DataFrame], style: Style, label: str
) -> pd.DataFrame:
    """A row for each label of any frame."""
    cells = [_marked(frame, style, table.columns) for frame in frames]
    titles = [style.escape(block.title) for block in blocks]
    body = pd.concat(cells, axis=1, keys=titles, sort=False)
    heads = pd.concat([frame["head"] for frame in frames]).groupby(level=0)
    counts = heads["counts"].agg(lambda sets: set().union(*sets))
    # The number of runs that a row's values are means of, if it is more than one.
    many = counts.map(lambda n: "" if n == {1} else f" (n = {', '.join(map(str, sorted(n)))})")
    names = heads["name"].first() + many
    heading = "Method" if table.runs["method"].nunique() > 1 else ""
    lead = {("", heading): names.map(lambda name: style.escape(label.format(name)))}
    if table.rows["protocol"].nunique() > 1:
        lead["", "Protocol"] = heads["protocol"].first().map(style.escape)
    return pd.concat([pd.DataFrame(lead).reindex(body.index), body], axis=1)


def _marked(frame: pd.DataFrame, style: Style, columns: Sequence[Column]) -> pd.DataFrame:
    cells = {}
    for column in columns:
        both = zip(frame["rank", column.title], frame["text", column.title], strict=True)
        marked = [style.marks[rank].format(style.escape(text)) for rank, text in both]
        cells[style.escape(column.heading)] = marked
    return pd.DataFrame(cells, index=frame.index, dtype=object)


def caption(table: Table) -> str:
    """The meaning of the measured numbers, and of their marks."""
    devices = table.runs["run.device"].dropna().unique()
    where = f" on {', '.join(devices)}" if len(devices) else ""
    repeated = bool((table.rows["count"] > 1).any())
    spread = " ± is the standard deviation over n runs." * repeated
    return (
        f"Measured{where}: means over the held-out images in motion, of a scene at rest over those "
        f"of the static set; peak GPU memory and wall-clock time of optimisation, all stages "
        f"together.{spread} Marks are within a scene, among measured rows; values that look the "
        "same share a mark."
    )


def reasons(collection: Collection) -> list[str]:
    """The failed runs, by their folders, and why they failed, a line each."""
    lines: list[str] = []
    for failure in collection.failures.to_dict("records"):
        bug = " (a fault of the program: see its run.log)" * (failure["mistake"] is False)
        lines.append(f"{failure['folder']}: {failure['error']}{bug}")
    return lines


MARKDOWN = Style(printed.markdown, ("{}", "**{}**", "<ins>{}</ins>", "*{}*"), "*{}*")
PLAIN = Style(str, ("{} ", "{}¹", "{}²", "{}³"))


def markdown(
    table: Table, figures: Mapping[str, str], videos: Mapping[str, str] | None = None
) -> str:
    """The whole report, with links to ``figures`` and ``videos``, by their captions."""
    collection = table.collection
    failed = f", {len(collection.failures)} failed" if len(collection.failures) else ""
    count = len(collection.runs)
    parts = [
        "# Runs compared",
        f"{count} finished run{'s' * (count != 1)} below `{collection.folder}`{failed}.",
        f"{printed.markdown(caption(table))} **Best**, <ins>second</ins>, *third*.",
    ]
    if table.shows_published:
        parts.append(f"† {printed.markdown(published().credit)}")
    for block in table.blocks:
        frame = cells_of(table, [block], MARKDOWN).droplevel(0, axis=1)
        labels = len(frame.columns) - len(table.columns)
        align = ["left"] * labels + ["right"] * len(table.columns)
        cells = frame.to_markdown(index=False, disable_numparse=True, colalign=align)
        parts += [f"## {printed.markdown(block.title)}", cells]
    if len(table.gains):
        gains = table.gains.map(printed.markdown).rename(columns=printed.markdown)
        cells = gains.to_markdown(index=False, disable_numparse=True)
        parts += ["## Gains over all scenes", cells]
    for heading, lines in (
        ("", table.notes),
        ("## Failed", reasons(collection)),
        ("## Skipped", collection.skipped),
    ):
        if lines:
            parts += [heading, "\n".join(f"- {printed.markdown(line)}" for line in lines)]
    if figures:
        parts.append("## Plots")
        parts += [f"![{printed.markdown(shows)}](<{link}>)" for shows, link in figures.items()]
    if videos:
        links = [f"- [{printed.markdown(shows)}](<{link}>)" for shows, link in videos.items()]
        parts += ["## Videos", "\n".join(links)]
    return "\n\n".join(filter(None, parts)) + "\n"


def plain(table: Table) -> str:
    """The tables, notes and failures, for a terminal; ¹ ² ³ mark the best."""
    parts = [_plain_block(table, block) + "\n" for block in table.blocks]
    if len(table.gains):
        parts.append(table.gains.to_string(index=False) + "\n")
    failed = [f"failed: {why}" for why in reasons(table.collection)]
    return "\n".join([*parts, *table.notes, *failed, *table.collection.skipped]).rstrip()


def _plain_block(table: Table, block: Block) -> str:
    frame = cells_of(table, [block], PLAIN).droplevel(0, axis=1)
    count = len(table.columns)
    heads = frame.iloc[:, :-count]
    cells = frame.iloc[:, -count:]
    heads = heads.apply(lambda column: column.str.ljust(column.str.len().max()))
    cells.index = heads.agg("  ".join, axis=1)
    cells.columns = [f"{heading} " for heading in cells.columns]
    cells.columns.name = block.title
    return "\n".join(line.rstrip() for line in cells.to_string().splitlines())


SIDE_BY_SIDE = 3
HEAD = r"""% Made by devrf; read it with \input. Needs no package. For marks in colour, define
%   \newcommand{\devrfbest}[1]{\cellcolor{red!30}#1}   % before it, with \usepackage[table]{xcolor}
% and \devrfsecond and \devrfthird alike.
\providecommand{\devrfbest}[1]{\textbf{#1}}
\providecommand{\devrfsecond}[1]{\underline{#1}}
\providecommand{\devrfthird}[1]{\textit{#1}}
"""
STYLE = Style(
    printed.latex,
    ("{}", r"\devrfbest{{{}}}", r"\devrfsecond{{{}}}", r"\devrfthird{{{}}}"),
    r"\textit{{{}}}",
)


def latex(table: Table) -> str:
    """The whole report; failures are comments, for a paper does not print them."""
    words = f"{caption(table)} Best, second and third are marked."
    words += f" † {published().credit}" if table.shows_published else ""
    parts = [HEAD]
    for start in range(0, len(table.blocks), SIDE_BY_SIDE):
        blocks = table.blocks[start : start + SIDE_BY_SIDE]
        parts.append(_tables(table, blocks, printed.latex(words)))
        words = "Continued."
    lines = [*table.notes, *(f"failed: {why}" for why in reasons(table.collection))]
    parts.append("".join(f"% {' '.join(line.split())}\n" for line in lines))
    return "\n".join(filter(None, parts))


def _tables(table: Table, blocks: Sequence[Block], words: str) -> str:
    frame = cells_of(table, blocks, STYLE)
    count = len(table.columns)
    labels = len(frame.columns) - count * len(blocks)
    above = [rf"\multicolumn{{{count}}}{{c|}}{{{STYLE.escape(block.title)}}}" for block in blocks]
    above[-1] = above[-1].replace("{c|}", "{c}", 1)  # no rule at the right edge
    lines = [r"\hline", _line([*[""] * labels, *above]), _line(frame.columns.get_level_values(1))]
    lines.append(r"\hline")
    for first, *cells in frame.itertuples(index=False):
        if any(cells):
            lines.append(_line([first, *cells]))
        else:  # the line above the published rows
            lines += [r"\hline", rf"\multicolumn{{{len(frame.columns)}}}{{l}}{{{first}}} \\"]
    formats = "|".join(["l" * labels, *["c" * count] * len(blocks)])
    begin = r"\scriptsize \setlength{\tabcolsep}{3pt} \begin{tabular}"
    return "\n".join(
        [r"\begin{table*}[t]", r"\centering", rf"\caption{{{words}}}", f"{begin}{{{formats}}}"]
        + [*lines, r"\hline", r"\end{tabular}", r"\end{table*}", ""]
    )


def _line(cells: Iterable[str]) -> str:
    return rf"{' & '.join(cells)} \\"
