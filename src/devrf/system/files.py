"""Files that are written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A path to write to that becomes ``path`` when the block ends well, and vanishes else."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays last: writers tell the format by it.
    partial = path.with_name(f".partial-{path.name}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write ``values`` as an indented JSON object."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(values, indent=2) + "\n")
