"""A report in Markdown, and as plain text for a terminal."""

from __future__ import annotations

import re
from collections.abc import Mapping

from devrf.apps.report.table import Block, Table
from devrf.apps.report.text import Style, caption, credit, printed, reasons


def escaped(text: str) -> str:
    """Text in which nothing is taken for Markdown."""
    return re.sub(r"([\\`*<>|\[\]])|((?<!\w)_|_(?!\w))", r"\\\1\2", text)


MARKDOWN = Style(escaped, ("{}", "**{}**", "<ins>{}</ins>", "*{}*"), "*{}*")
PLAIN = Style(str, ("{} ", "{}¹", "{}²", "{}³"))


def markdown(
    table: Table, figures: Mapping[str, str], films: Mapping[str, str] | None = None
) -> str:
    """The whole report, with links to ``figures`` and ``films``, by what they show."""
    found = table.found
    failed = f", {len(found.failures)} failed" if len(found.failures) else ""
    count = len(found.runs)
    parts = [
        "# Runs compared",
        f"{count} finished run{'s' * (count != 1)} below `{found.folder}`{failed}.",
        f"{escaped(caption(table))} **Best**, <ins>second</ins>, *third*.",
    ]
    if table.shows_published:
        parts.append(f"† {escaped(credit())}")
    for block in table.blocks:
        parts += [f"## {escaped(block.title)}", _block(table, block)]
    for heading, lines in (
        ("", table.notes),
        ("## Failed", reasons(found)),
        ("## Skipped", found.skipped),
    ):
        if lines:
            parts += [heading, "\n".join(f"- {escaped(line)}" for line in lines)]
    if figures:
        parts.append("## Plots")
        parts += [f"![{escaped(shows)}](<{link}>)" for shows, link in figures.items()]
    if films:
        parts.append("## Videos")
        parts.append("\n".join(f"- [{escaped(show)}](<{link}>)" for show, link in films.items()))
    return "\n\n".join(filter(None, parts)) + "\n"


def plain(table: Table) -> str:
    """The tables, notes and failures, for a terminal; ¹ ² ³ mark the best."""
    parts = [_plain_block(table, block) + "\n" for block in table.blocks]
    failed = [f"failed: {why}" for why in reasons(table.found)]
    return "\n".join([*parts, *table.notes, *failed, *table.found.skipped]).rstrip()


def _block(table: Table, block: Block) -> str:
    frame = printed(table, [block], MARKDOWN).droplevel(0, axis=1)
    left = len(frame.columns) - len(table.columns)
    align = ["left"] * left + ["right"] * len(table.columns)
    return str(frame.to_markdown(index=False, disable_numparse=True, colalign=align))


def _plain_block(table: Table, block: Block) -> str:
    frame = printed(table, [block], PLAIN).droplevel(0, axis=1)
    count = len(table.columns)
    heads, cells = frame.iloc[:, :-count], frame.iloc[:, -count:]
    heads = heads.apply(lambda column: column.str.ljust(column.str.len().max()))
    cells.index = heads.agg("  ".join, axis=1)
    cells.columns = [f"{heading} " for heading in cells.columns]
    cells.columns.name = block.title
    return "\n".join(line.rstrip() for line in cells.to_string().splitlines())
