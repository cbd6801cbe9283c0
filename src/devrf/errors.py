"""The project's own error type: what a user can put right, said in one line."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class DevrfError(Exception):
    """A mistake in the input (a file, a key, a checkpoint) that the user can put right.

    The message is one line: it names the file or key, what was expected, and what to do.
    The command line prints it and exits with status 2; nothing has been half-written.
    """


def expect(met: bool, key: str, expected: str, value: object) -> None:
    """Refuse the ``value`` of a config key unless the condition is ``met``.

    Args:
        met: whether the value is good.
        key: its place in the config.
        expected: what it may be: ``at least 1``.
        value: what it is.

    Raises:
        DevrfError: it is not.
    """
    if not met:
        raise DevrfError(f"{key}: expected {expected}, not {value}")


def did_you_mean(word: object, known: Iterable[object], before: str = "") -> str:
    """The end of a message that names the closest of the known words, empty where none is close.

    Args:
        word: what was given.
        known: what there is.
        before: what is written before the word: ``data=``.
    """
    close = difflib.get_close_matches(str(word), [str(candidate) for candidate in known], n=1)
    return f"; did you mean {before}{close[0]}?" if close else ""
