"""JSON files that hold an object, and the numbers in them: read with one clear line on failure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from devrf.scenes.paths import existing_file
from devrf.scenes.validation import abbreviated, number, scene_error

# Some 60,000 posed images with every number on a line of its own.
MAX_BYTES = 64 * 2**20
# As many images without white space. Python takes up to 100 bytes for each value and key.
MAX_VALUES = 4_000_000
_BEFORE_VALUES = b"[{,:"


def json_object(file: Path, purpose: str) -> dict[str, Any]:
    """The content of a JSON file; of a key that is there twice, the last one.

    Args:
        file: a file that holds one object.
        purpose: what it is needed for, for the message when it is missing.

    Raises:
        DevrfError: there is no such file, it is no JSON, it holds something else, or it is so
            large that it cannot be a list of images.
    """
    if existing_file(file, purpose) > MAX_BYTES:
        raise scene_error(
            file,
            f"larger than {MAX_BYTES >> 20} MiB, expected a list of posed images; write it again",
        )
    try:
        data = file.read_bytes()
    except OSError as error:
        raise scene_error(file, f"cannot be read ({error.strerror}); {purpose}") from None
    # Counted before they are made: two bytes of text can become a hundred of memory.
    if sum(data.count(byte) for byte in _BEFORE_VALUES) > MAX_VALUES:
        raise scene_error(
            file,
            f"holds more than {MAX_VALUES // 10**6} million values, expected a list of "
            "posed images; write it again",
        )
    try:
        # Some editors begin a file with a byte order mark.
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise scene_error(file, f"not valid JSON ({error}); write it again") from None
    if not isinstance(content, dict):
        raise scene_error(file, f"expected a JSON object, not {type(content).__name__}; {purpose}")
    return content


def numbers(content: dict[str, Any], key: str, count: int, where: object) -> list[float]:
    """The ``count`` finite numbers that ``content`` lists under ``key``; else DevrfError."""
    values = content.get(key)
    if not isinstance(values, list) or len(values) != count:
        raise scene_error(where, f'expected {count} numbers as "{key}", not {abbreviated(values)}')
    found = [number(value) for value in values]
    kept = [value for value in found if value is not None]
    if len(kept) < count:
        raise scene_error(where, f'"{key}" holds NaN, inf or text; give {count} finite numbers')
    return kept
