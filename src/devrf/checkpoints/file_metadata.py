"""Metadata of a checkpoint file, read from its header without torch."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from devrf.errors import DevrfError
from devrf.system.files import UNREADABLE

FORMAT = "6"
# Key of a training config for the digest of the run's canonical checkpoint that is built on.
OWN_REST = "checkpoints/canonical.ckpt"
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
            f"{path}: has format {metadata['devrf'][:9]}, this version of devrf reads {FORMAT}; "
            "use the version that wrote it, or train again"
        )
    return metadata


def latest_checkpoint(run: Path) -> Path | None:
    """The checkpoint of the latest stage in a run's folder, else its furthest progress file.

    The files' contents decide: a copy of the folder has other times. A checkpoint that builds on
    another canonical field than the run's is passed over. None without one.
    """
    latest: list[tuple[int, float, Path]] = []
    for path in (run / "checkpoints").glob("*.ckpt"):
        with suppress(DevrfError, OSError, *UNREADABLE):
            content = _entries(json.loads(file_metadata(path)["nested"]))
            metadata = _entries(content["devrf"])
            rest = _entries(metadata["training_config"]).get(OWN_REST)
            if rest and (run / OWN_REST).is_file() and rest != digest_of(run / OWN_REST):
                continue
            progress = content.get("progress")
            at = float(_entries(progress)["iteration"]) if progress else math.inf
            latest.append((len(_entries(metadata["records"])), at, path))
    return max(latest)[2] if latest else None


def _entries(node: Any) -> dict[str, Any]:
    """The entries of a dict as devrf.checkpoints.checkpoint_file writes it into JSON."""
    return dict(node["dict"])
