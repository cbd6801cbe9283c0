"""Sentences and cells that Markdown, plain text and LaTeX share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pandas as pd

from devrf.apps.report.published import published
from devrf.apps.report.runs import Collection
from devrf.apps.report.table import Block, Column, Table


@dataclass(frozen=True)
class Style:
    """How a format writes text.

    Attributes:
        escape: makes plain text safe in it.
        marks: formats of a cell: unmarked, best, second, third.
        heading: format of the line above the published rows.
    """

    escape: Callable[[str], str]
    marks: tuple[str, str, str, str]
    heading: str = "{}"


def printed(table: Table, blocks: Sequence[Block], style: Style) -> pd.DataFrame:
    """Blocks side by side as text: measured rows, then published ones below a line of their own.

    Returns:
        Columns of two levels: the label, and the protocol where it differs, below an empty title;
        then each block's title with every metric's heading below it. What a block does not have is
        empty.
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
    found = pd.concat(cells, axis=1, keys=titles, sort=False)
    heads = pd.concat([frame["head"] for frame in frames]).groupby(level=0)
    counts = heads["counts"].agg(lambda sets: set().union(*sets))
    names = heads["name"].first() + counts.map(_repeats)
    heading = "Method" if table.runs["method"].nunique() > 1 else ""
    lead = {("", heading): names.map(lambda name: style.escape(label.format(name)))}
    if table.rows["protocol"].nunique() > 1:
        lead["", "Protocol"] = heads["protocol"].first().map(style.escape)
    return pd.concat([pd.DataFrame(lead).reindex(found.index), found], axis=1)


def _marked(frame: pd.DataFrame, style: Style, columns: Sequence[Column]) -> pd.DataFrame:
    def mark(rank: int, text: str) -> str:
        return style.marks[rank].format(style.escape(text))

    cells = {
        style.escape(column.heading): list(
            map(mark, frame["rank", column.title], frame["text", column.title])
        )
        for column in columns
    }
    return pd.DataFrame(cells, index=frame.index, dtype=object)


def _repeats(counts: set[int]) -> str:
    """How many runs a row's values are means of, in parentheses; nothing where it is one."""
    return "" if counts == {1} else f" (n = {', '.join(map(str, sorted(counts)))})"


def caption(table: Table) -> str:
    """What the measured numbers are, and which of them are marked."""
    devices = table.runs["run.device"].dropna().unique()
    where = f" on {', '.join(devices)}" if len(devices) else ""
    repeated = bool((table.rows["count"] > 1).any())
    spread = " ± is the standard deviation over n runs." * repeated
    return (
        f"Measured{where}: means over the held-out images of the dynamic scene; peak GPU memory "
        f"and wall-clock time of optimisation, all stages together.{spread} Marks are within a "
        "scene, among measured rows; values that look the same share a mark."
    )


def credit() -> str:
    """The source of the published rows."""
    paper = published()
    return (
        f"As published in {paper.authors}: {paper.title}. {paper.venue}; measured by its authors "
        f"on an {paper.hardware}, other hardware than ours, and not marked. What they call Ours "
        "is DeVRF here."
    )


def reasons(found: Collection) -> list[str]:
    """Which runs failed, and why, a line each; overrides that all runs share are left out."""
    overrides = pd.concat([found.runs["run.overrides"], found.failures["run.overrides"]])
    typed = [set(own) for own in overrides]
    shared = set.intersection(*typed) if len(typed) > 1 else set()
    lines: list[str] = []
    for failure in found.failures.to_dict("records"):
        own = [text for text in failure["run.overrides"] if text not in shared]
        what = " ".join([failure["scene"] or "unknown scene", *own])
        bug = " (a fault of the program: see its run.log)" * (failure["mistake"] is False)
        lines.append(f"{failure['folder']} ({what}): {failure['error']}{bug}")
    return lines
