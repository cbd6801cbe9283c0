"""Text from elsewhere, made harmless where it is shown. A function for each target.

HTML's is :func:`html.escape`; matplotlib's is ``text.parse_math`` false.
"""

from __future__ import annotations

import logging
import re
from copy import copy
from unicodedata import bidirectional, category

# Control characters, halves of characters, ends of lines and paragraphs.
CONTROLS = ("Cc", "Cs", "Zl", "Zp")
# They turn the direction of all that follows.
TURNS = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
# pandas' own escapes leave the symbols below the first two lines as they are.
LATEX = str.maketrans(
    {character: rf"\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': "''", "–": "--"}
    | {"±": r"$\pm$", "×": r"$\times$", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "†": r"$\dagger$"}
)


def is_shown(text: str) -> bool:
    """Whether a terminal shows a text, in one line, and obeys nothing in it."""
    return not any(category(sign) in CONTROLS or bidirectional(sign) in TURNS for sign in text)


def shown(text: str) -> str:
    """Text in one line as a terminal may have it; the other targets build on it."""
    return "".join(s if is_shown(s) else " " if s.isspace() else "?" for s in text)


def markdown(text: str) -> str:
    """Text in which nothing is taken for Markdown, nor for the HTML that it may hold."""
    return re.sub(r"([\\`*<>|\[\]&#~$])|((?<!\w)_|_(?!\w))", r"\\\1\2", shown(text))


def latex(text: str) -> str:
    """Text in which nothing is taken for a command."""
    return shown(text).translate(LATEX)


def csv_cell(text: str) -> str:
    """Text that no spreadsheet takes for a formula: signed numbers are none."""
    return re.sub(r"^(?=[=+@-])(?![+-][\d.]+(e[+-]?\d+)?$)", "'", shown(text))


class LogFormatter(logging.Formatter):
    """Lines of a log as a terminal may have them."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as text."""
        return "\n".join(map(shown, super().format(record).split("\n")))


class TerminalFormatter(LogFormatter):
    """The same without tracebacks, which are in the run's log."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as text."""
        said = copy(record)  # other formatters get the record, too
        said.exc_info = said.exc_text = None
        return super().format(said)
