"""A report in Markdown, and as plain text for a terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from devrf.reporting.columns import Cell
from devrf.reporting.table import Block, Row, Table
from devrf.reporting.text import (
    aligned,
    caption,
    credit,
    headings,
    published_heading,
    reasons,
    valid_mask,
)

MARKS = {1: "**{}**", 2: "<ins>{}</ins>", 3: "*{}*", None: "{}"}
PLAIN_MARKS = {1: "{}¹", 2: "{}²", 3: "{}³", None: "{} "}


def markdown(table: Table, figures: Mapping[str, str], remarks: Sequence[str] = ()) -> str:
    """The whole report.

    Args:
        table: what it says.
        figures: links to plots, by what they show.
        remarks: further sentences for the reader.
    """
    found = table.found
    failed = f", {len(found.failures)} failed" if found.failures else ""
    parts = [
        "# Runs compared",
        f"{_runs(len(found.runs))} below `{found.folder}`{failed}.",
        f"{escaped(caption(table))} **Best**, <ins>second</ins>, *third*.",
    ]
    if table.shows_published:
        parts.append(f"† {escaped(credit())}")
    for block in table.blocks:
        parts += [f"## {escaped(block.title)}", _table(block)]
    notes = [*table.notes, *remarks]
    if notes:
        parts.append("\n".join(f"- {escaped(note)}" for note in notes))
    if found.failures:
        parts += ["## Failed", "\n".join(f"- {escaped(line)}" for line in reasons(found))]
    if found.skipped:
        parts += ["## Skipped", "\n".join(f"- {escaped(line)}" for line in found.skipped)]
    if figures:
        parts.append("## Plots")
        parts += [f"![{escaped(shows)}](<{link}>)" for shows, link in figures.items()]
    return "\n\n".join(parts) + "\n"


def plain(table: Table, remarks: Sequence[str] = ()) -> str:
    """The tables, notes and failures, for a terminal; ¹ ² ³ mark the best.

    Args:
        table: what it says.
        remarks: further sentences for the reader.
    """
    lines: list[str] = []
    for block in table.blocks:
        rows = [[block.title, *(f"{text} " for text in headings())]]
        rows += [_cells(row, PLAIN_MARKS, str) for row in block.measured]
        if block.published:
            rows += [[published_heading(), *[""] * len(headings())]]
            rows += [_cells(row, PLAIN_MARKS, "† {}".format) for row in block.published]
        lines += ["  ".join(row).rstrip() for row in aligned(rows)] + [""]
    lines += [*table.notes, *remarks, *(f"failed: {why}" for why in reasons(table.found))]
    return "\n".join([*lines, *table.found.skipped]).rstrip()


def escaped(text: str) -> str:
    """Text in which nothing is taken for Markdown."""
    return re.sub(r"([\\`*<>|\[\]])|((?<!\w)_|_(?!\w))", r"\\\1\2", text)


def _runs(count: int) -> str:
    return "1 finished run" if count == 1 else f"{count} finished runs"


def _table(block: Block) -> str:
    head = ["", *headings()]
    rows = [head, *(_cells(row, MARKS, escaped) for row in block.measured)]
    if block.published:
        rows.append([f"*{published_heading()}*", *[""] * len(headings())])
        rows += [_cells(row, MARKS, lambda text: f"† {escaped(text)}") for row in block.published]
    first, *others = aligned(rows)
    rule = [":" + "-" * (len(first[0]) - 1), *("-" * (len(cell) - 1) + ":" for cell in first[1:])]
    return "\n".join(f"| {' | '.join(row)} |" for row in (first, rule, *others))


def _cells(row: Row, marks: Mapping[int | None, str], label: Callable[[str], str]) -> list[str]:
    def marked(cell: Cell) -> str:
        return marks[cell.rank].format(cell.text)

    return [label(row.label + valid_mask(row.seeds)), *map(marked, row.cells)]
