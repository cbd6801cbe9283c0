r"""Turns the equations of a page, \(…\) and \[…\], into MathML when the site is built.

Browsers show MathML themselves: pages need neither a script nor a network.
"""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

# What pymdownx.arithmatex makes of an equation.
EQUATION = re.compile(
    r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>',
    re.DOTALL,
)


def on_page_content(page_html: str, **kwargs: Any) -> str:
    """Replace every equation of a rendered page."""
    return EQUATION.sub(as_mathml, page_html)


def as_mathml(equation: re.Match[str]) -> str:
    """One equation, in the line or in lines of its own."""
    display = "block" if equation[1] == "div" else "inline"
    return convert(html.unescape(equation[2]), display=display)
