"""JSON files that hold an object, and the numbers in them: read with one clear line on failure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from devrf.scenes.validation import number, problem


def json_object(file: Path, purpose: str) -> dict[str, Any]:
    """The content of a JSON file.

    Args:
        file: a file that holds one object.
        purpose: what it is needed for, for the message when it is missing.

    Raises:
        DevrfError: there is no such file, it is no JSON, or it holds something else.
    """
    if not file.is_file():
        raise problem(file, f"no such file; {purpose}")
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise problem(file, f"not valid JSON ({error}); write it again") from None
    if not isinstance(content, dict):
        raise problem(file, f"expected a JSON object, not {type(content).__name__}; {purpose}")
    return content


def numbers(content: dict[str, Any], key: str, count: int, where: object) -> list[float]:
    """The ``count`` finite numbers that ``content`` lists under ``key``; else DevrfError."""
    values = content.get(key)
    if not isinstance(values, list) or len(values) != count:
        raise problem(where, f'expected {count} numbers as "{key}", not {_short(values)}')
    found = [number(value) for value in values]
    kept = [value for value in found if value is not None]
    if len(kept) < count:
        raise problem(where, f'"{key}" holds NaN, inf or text; give {count} finite numbers')
    return kept


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
