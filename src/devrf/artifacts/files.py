"""Files that are written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path to write to that becomes ``path`` when the block ends well, and vanishes else."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays last: writers tell the format by it.
    partial = path.with_name(f".partial-{path.name}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def update_json(path: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Put ``values`` over what the JSON object in ``path`` holds, key by key; what results."""
    try:
        held = json.loads(path.read_text())
    except (OSError, ValueError):
        held = {}
    merged = {**(held if isinstance(held, dict) else {}), **values}
    with whole_file(path) as partial:
        partial.write_text(json.dumps(merged, indent=2) + "\n")
    return merged
