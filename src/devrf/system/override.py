"""Settings as words to type, which reach the config as the values that were printed.

Two readers come between a terminal and the config: the shell, and Hydra's grammar of overrides.
"""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

from devrf.errors import DevrfError
from devrf.system.files import utf8_path

# Text that the grammar takes for the same text: no number, no truth value, no open bracket.
_PLAIN = re.compile(
    r"(?!(?:true|false|null|nan|inf)$)(?:[a-z_/]|\.+/)[\w/.-]*", re.ASCII | re.IGNORECASE
)
# The end of a text in quotes, or a quote: backslashes before it count as half as many.
_ENDING = re.compile(r'(\\*)("|$)')


def to_type(key: str, value: object) -> str:
    """``key=value`` as a shell takes it, for a path, text, number, truth value, None or a list.

    DevrfError for a path that no config can hold.
    """
    return shlex.quote(f"{key}={literal(value)}")


def literal(value: object) -> str:
    """A value in Hydra's grammar, for which text is text whatever it holds.

    DevrfError for a path that no config can hold.
    """
    if isinstance(value, list | tuple):
        return f"[{','.join(map(literal, value))}]"
    if isinstance(value, Path):
        return literal(without_reference(value))
    if isinstance(value, str):
        if _PLAIN.fullmatch(value):
            return value
        # An empty end has nothing to double.
        escaped = _ENDING.sub(lambda end: end[1] * 2 + end[2].replace('"', '\\"'), value)
        return f'"{escaped}"'
    return str(value) if isinstance(value, float) else json.dumps(value)


def without_reference(path: Path) -> str:
    """The text of a path, in which a config finds no reference to another key; else DevrfError.

    A reference can be escaped once, but a config is resolved more often than that.
    """
    text = str(utf8_path(path))
    if "${" in text:
        raise DevrfError(f"{text}: its name holds ${{, where a config puts another key; rename it")
    return text
