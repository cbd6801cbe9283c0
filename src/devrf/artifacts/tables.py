"""Titled tables for a terminal, and the same as plain text for a log."""

from __future__ import annotations

import io
from collections.abc import Sequence

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

# Wider than any line: a log wraps no cell.
LOG_WIDTH = 10_000


def titled_table(
    title: str, rows: Sequence[Sequence[str]], heading: Sequence[str] | None = None
) -> RenderableType:
    """An indented table with a title above and an empty line below.

    Args:
        title: what it is about.
        rows: cells of text, the same number in every row.
        heading: names of the columns; None for a table without these.
    """
    table = Table(box=None, show_header=heading is not None, padding=(0, 2, 0, 0))
    for k, name in enumerate(heading or [""] * len(rows[0])):
        table.add_column(name, style="" if k else "cyan")
    for row in rows:
        table.add_row(*map(Text, row))  # Text: a name may hold [brackets]
    return Group(Text(title, style="bold"), Padding(table, (0, 0, 1, 2)))


def as_text(shown: RenderableType) -> str:
    """What a terminal would show, without colours and trailing spaces."""
    console = Console(file=io.StringIO(), width=LOG_WIDTH, record=True)
    console.print(shown)
    lines = console.export_text().splitlines()
    return "\n".join(line.rstrip() for line in lines)
