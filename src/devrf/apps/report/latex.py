r"""A report as LaTeX tables, up to three scenes side by side, to be read with ``\input``."""

from __future__ import annotations

import re
from collections.abc import Sequence

from devrf.apps.report.table import Block, Table
from devrf.apps.report.text import Style, caption, credit, printed, reasons

SIDE_BY_SIDE = 3
HEAD = r"""% Made by devrf; read it with \input. Needs no package. For marks in colour, define
%   \newcommand{\devrfbest}[1]{\cellcolor{red!30}#1}   % before it, with \usepackage[table]{xcolor}
% and \devrfsecond and \devrfthird alike.
\providecommand{\devrfbest}[1]{\textbf{#1}}
\providecommand{\devrfsecond}[1]{\underline{#1}}
\providecommand{\devrfthird}[1]{\textit{#1}}
"""
# pandas' own escapes leave the symbols below the first two lines as they are.
SPECIAL = str.maketrans(
    {character: rf"\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': "''", "–": "--"}
    | {"±": r"$\pm$", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "†": r"$\dagger$"}
)
COMMANDS = {
    **dict.fromkeys(("toprule", "midrule", "bottomrule"), ":hline"),
    "scriptsize": ":{}",
    "setlength": r":{\tabcolsep}{3pt}",
}


def escaped(text: str) -> str:
    """Text in which nothing is taken for a command."""
    return text.translate(SPECIAL)


STYLE = Style(
    escaped,
    ("{}", r"\devrfbest{{{}}}", r"\devrfsecond{{{}}}", r"\devrfthird{{{}}}"),
    r"\textit{{{}}}",
)


def latex(table: Table) -> str:
    """The whole report; failures are comments, for a paper does not print them."""
    words = f"{caption(table)} Best, second and third are marked."
    words += f" † {credit()}" if table.shows_published else ""
    parts = [HEAD]
    for start in range(0, len(table.blocks), SIDE_BY_SIDE):
        parts.append(_tables(table, table.blocks[start : start + SIDE_BY_SIDE], escaped(words)))
        words = "Continued."
    lines = [*table.notes, *(f"failed: {why}" for why in reasons(table.found))]
    parts.append("".join(f"% {' '.join(line.split())}\n" for line in lines))
    return "\n".join(filter(None, parts))


def _tables(table: Table, blocks: Sequence[Block], words: str) -> str:
    frame = printed(table, blocks, STYLE)
    width = len(frame.columns)
    left = "l" * (width - len(table.columns) * len(blocks))
    style = frame.style.hide(axis="index").set_table_styles(
        [{"selector": command, "props": options} for command, options in COMMANDS.items()]
    )
    text = style.to_latex(
        column_format="|".join([left, *["c" * len(table.columns)] * len(blocks)]),
        multicol_align="c|",
        environment="table*",
        position="t",
        position_float="centering",
        caption=words,
    )
    text = "{c}".join(text.rsplit("{c|}", 1))  # no rule at the right edge
    # The line above the published rows goes over all columns.
    above = rf"\\hline\n\\multicolumn{{{width}}}{{l}}{{\1}} \\\\"
    return re.sub(r"^(\\textit\{[^&]*\})[ &]*\\\\$", above, text, flags=re.MULTILINE)
