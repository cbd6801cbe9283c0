"""JSON files read by pydantic, with one clear line on failure."""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from devrf.scenes.paths import existing_file
from devrf.scenes.validation import LARGEST, first_error, scene_error

# Some 60,000 posed images with every number on a line of its own.
MAX_BYTES = 64 * 2**20
# As many images without white space. A parser takes up to 300 bytes for each value and key.
MAX_VALUES = 4_000_000
_BEFORE_VALUES = b"[{,:"

# A number that float32 holds: no text, no truth value, neither NaN nor infinity.
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=-LARGEST, lt=LARGEST)]
Positive = Annotated[Number, Field(gt=0)]
Vector2 = tuple[Number, Number]
Vector3 = tuple[Number, Number, Number]
Vector4 = tuple[Number, Number, Number, Number]
Name = Annotated[str, Field(min_length=1)]


def _distinct(ids: list[str]) -> list[str]:
    if len(set(ids)) < len(ids):
        raise ValueError("expected a list of distinct ids; correct it")
    return ids


Ids = Annotated[list[Name], Field(fail_fast=True), AfterValidator(_distinct)]

Content = TypeVar("Content")


def read_json(file: Path, kind: TypeAdapter[Content], purpose: str) -> Content:
    """The content of a JSON file; of a key that is there twice, the last one counts.

    Args:
        file: a file that holds one object.
        kind: what the object must be.
        purpose: what the file is needed for, for the message when it is missing.

    Raises:
        DevrfError: there is no such file, it is no JSON, a key is missing or its value wrong, or
            the file is so large that it cannot be a list of images.
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
    # Counted before they are made: two bytes of text can become hundreds of memory.
    if sum(data.count(byte) for byte in _BEFORE_VALUES) > MAX_VALUES:
        raise scene_error(
            file,
            f"holds more than {MAX_VALUES // 10**6} million values, expected a list of "
            "posed images; write it again",
        )
    try:
        # Some editors begin a file with a byte order mark.
        return kind.validate_json(data.removeprefix(codecs.BOM_UTF8))
    except ValidationError as error:
        raise first_error(error, f"{file}: ") from None
