"""What a checkpoint file says of itself, read from its header, without torch."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from safetensors import SafetensorError, safe_open

from devrf.errors import DevrfError

FORMAT = "5"
# Bytes of a header at most: usual are 20,000. In memory each may become 50.
HEADER = 2**23


def digest_of(path: Path) -> str:
    """The SHA-256 of a file's content, in hexadecimal; "" if it is no checkpoint."""
    try:
        return file_metadata(path)["sha256"]
    except DevrfError:
        return ""


def file_metadata(path: Path) -> dict[str, str]:
    """The metadata of a file: ``devrf``, ``sha256`` and ``nested``."""
    if not path.is_file():  # a pipe would be waited for
        raise DevrfError(f"{path}: no file; set ckpt to one that devrf wrote")
    metadata: dict[str, str] = {}
    with path.open("rb") as start:
        length = int.from_bytes(start.read(8), "little")
    with suppress(SafetensorError):
        if length <= HEADER:
            with safe_open(path, "np") as file:
                metadata = file.metadata() or {}
    if not {"devrf", "sha256", "nested"} <= set(metadata):
        raise DevrfError(
            f"{path}: not a devrf checkpoint, or a damaged one; set ckpt to a whole file that "
            "devrf wrote"
        )
    if metadata["devrf"] != FORMAT:
        raise DevrfError(
            f"{path}: has format {metadata['devrf']}, this version of devrf reads {FORMAT}; use "
            "the version that wrote it, or train again"
        )
    return metadata
