"""Titled tables of words and numbers: for a terminal, and as plain text for a log."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from rich import box as borders
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text


@dataclass(frozen=True)
class Section:
    """A titled table.

    Attributes:
        title: what it is about.
        rows: cells of text, of one number in all rows; the first row is the heading if
            ``heading`` is set.
        heading: whether the first row names the columns.
    """

    title: str
    rows: tuple[tuple[str, ...], ...]
    heading: bool = False


def as_lines(sections: Iterable[Section]) -> list[str]:
    """Lines of plain text, columns aligned."""
    lines: list[str] = []
    for section in sections:
        widths = [max(map(len, column)) for column in zip(*section.rows, strict=True)]
        lines.append(section.title)
        for row in section.rows:
            cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
            lines.append(("  " + "  ".join(cells)).rstrip())
    return lines


def as_tables(sections: Iterable[Section]) -> list[RenderableType]:
    """Tables for a terminal, an empty line after each."""
    parts: list[RenderableType] = []
    for section in sections:
        table = Table(
            title=section.title,
            title_justify="left",
            title_style="bold",
            box=borders.SIMPLE_HEAD if section.heading else None,
            show_header=section.heading,
        )
        rows = section.rows
        for name in rows[0] if section.heading else [""] * len(rows[0]):
            table.add_column(name, style="" if table.columns else "cyan")
        for row in rows[1:] if section.heading else rows:
            table.add_row(*map(Text, row))  # Text: a name may hold [brackets]
        parts += [table, Text()]
    return parts
