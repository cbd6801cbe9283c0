r"""A report as LaTeX tables, up to three scenes side by side, to be read with ``\input``."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from devrf.reporting.columns import COLUMNS, Cell
from devrf.reporting.table import Block, Row, Table
from devrf.reporting.text import (
    caption,
    credit,
    headings,
    published_heading,
    reasons,
    valid_mask,
)

SIDE_BY_SIDE = 3
MARKS = {1: r"\devrfbest{%s}", 2: r"\devrfsecond{%s}", 3: r"\devrfthird{%s}", None: "%s"}
EMPTY = (Cell(None, ""),) * len(COLUMNS)
HEAD = r"""% Made by devrf; read it with \input. Needs no package. For marks in colour, define
%   \newcommand{\devrfbest}[1]{\cellcolor{red!30}#1}   % before it, with \usepackage[table]{xcolor}
% and \devrfsecond and \devrfthird alike.
\providecommand{\devrfbest}[1]{\textbf{#1}}
\providecommand{\devrfsecond}[1]{\underline{#1}}
\providecommand{\devrfthird}[1]{\textit{#1}}
"""
SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "–": "--",
    "†": r"$\dagger$",
}


def latex(table: Table, remarks: Sequence[str] = ()) -> str:
    """The whole report; failures are comments, for a paper does not print them.

    Args:
        table: what it says.
        remarks: further sentences for the reader.
    """
    words = f"{caption(table)} Best, second and third are marked."
    words += f" † {credit()}" if table.shows_published else ""
    parts = [HEAD]
    for start in range(0, len(table.blocks), SIDE_BY_SIDE):
        parts.append(_tabular(table.blocks[start : start + SIDE_BY_SIDE], escaped(words)))
        words = "Continued."
    lines = [*table.notes, *remarks, *(f"failed: {why}" for why in reasons(table.found))]
    parts.append("".join(f"% {' '.join(line.split())}\n" for line in lines))
    return "\n".join(part for part in parts if part)


def escaped(text: str) -> str:
    """Text in which nothing is taken for a command."""
    return re.sub("|".join(map(re.escape, SPECIAL)), lambda found: SPECIAL[found[0]], text)


def _tabular(blocks: Sequence[Block], words: str) -> str:
    width = len(COLUMNS)
    titles = [
        rf"\multicolumn{{{width}}}{{c{'|' * (block is not blocks[-1])}}}{{{escaped(block.title)}}}"
        for block in blocks
    ]
    lines = [
        r"\begin{table*}[t]",
        r"\centering",
        rf"\caption{{{words}}}",
        r"\scriptsize",
        r"\setlength{\tabcolsep}{3pt}",
        rf"\begin{{tabular}}{{l|{'|'.join(['c' * width] * len(blocks))}}}",
        r"\hline",
        _line(["", *titles]),
        _line(["", *(escaped(text) for _ in blocks for text in headings())]),
        r"\hline",
        *_rows([block.measured for block in blocks], "{}".format),
    ]
    if any(block.published for block in blocks):
        span = rf"\multicolumn{{{1 + width * len(blocks)}}}{{l}}"
        lines += [r"\hline", rf"{span}{{\textit{{{escaped(published_heading())}}}}} \\"]
        lines += _rows([block.published for block in blocks], "† {}".format)
    return "\n".join([*lines, r"\hline", r"\end{tabular}", r"\end{table*}", ""])


def _rows(blocks: Sequence[Sequence[Row]], label: Callable[[str], str]) -> list[str]:
    """One line for each label of any block; a block that does not have it stays empty."""
    lines: list[str] = []
    for name in dict.fromkeys(row.label for rows in blocks for row in rows):
        own = [next((row for row in rows if row.label == name), None) for rows in blocks]
        cells = [cell for row in own for cell in (row.cells if row else EMPTY)]
        seeds = {count for row in own if row for count in row.seeds}
        lines.append(_line([escaped(label(name) + valid_mask(seeds)), *map(_cell, cells)]))
    return lines


def _cell(cell: Cell) -> str:
    return MARKS[cell.rank] % escaped(cell.text)


def _line(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"
