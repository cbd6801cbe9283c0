"""Text from elsewhere in terminals, logs, Markdown, LaTeX and tables."""

from __future__ import annotations

import logging

import pytest

from devrf.system.printed import LogFormatter, csv_cell, is_shown, latex, markdown, shown


@pytest.mark.parametrize("sign", ["\x1b", "\x07", "\0", "\x9b", "\udc80", "\u202e", "\u2066"])
def test_a_terminal_gets_no_commands(sign):
    assert shown(f"a{sign}b") == "a?b" and not is_shown(f"a{sign}b")


@pytest.mark.parametrize("sign", ["\n", "\r", "\t", "\u2028", "\u2029", "\x85"])
def test_lines_stay_lines(sign):
    assert shown(f"a{sign}b") == "a b" and not is_shown(f"a{sign}b")


@pytest.mark.parametrize("name", ["שלום 1", "क्‍ष", "Aufnahme\u202f12", "👩‍🔬", "a  b"])
def test_names_of_all_languages_are_as_they_are(name):
    assert shown(name) == name and is_shown(name)


def test_lines_of_a_log_are_those_of_its_message():
    record = logging.LogRecord("x", logging.INFO, "", 0, "%s\nb", ("\x1b[2Ja",), None)
    assert LogFormatter("%(levelname)s %(message)s").format(record) == "INFO ?[2Ja\nb"


def test_markup_is_text():
    assert markdown("pig_toy _a_ a|b <`[&#\x1b") == r"pig_toy \_a\_ a\|b \<\`\[\&\#?"
    assert latex("pig_toy 100 % & $x^2$") == r"pig\_toy 100 \% \& \$x\textasciicircum{}2\$"
    assert latex("2×9 ± 1 ↑ <|") == r"2$\times$9 $\pm$ 1 $\uparrow$ \textless{}\textbar{}"


@pytest.mark.parametrize("text", ["=1+1", "+a", "-2+3", "@SUM(A1)", "-cmd|' /C'!A0"])
def test_a_spreadsheet_gets_no_formula(text):
    assert csv_cell(text) == f"'{text}"


@pytest.mark.parametrize("text", ["-1.5", "+1e-05", "a=b", "", "1"])
def test_numbers_and_other_text_stay(text):
    assert csv_cell(text) == text
