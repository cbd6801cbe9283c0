"""Results of steps, kept in files together with what they were found from."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from devrf.system.files import write_json

log = logging.getLogger(__name__)

# Part of every key: a change of a step makes what was kept before foreign.
VERSION = 1


def kept(
    file: Path, source: Any, make: Callable[[], dict[str, Any]], *, files: Path | None = None
) -> dict[str, Any]:
    """What ``make`` returns, or what it returned before from the same source.

    Args:
        file: the JSON file that keeps it.
        source: all that it depends on, as JSON can hold it.
        make: finds it anew.
        files: a folder of files that belong to it; without it, it is found anew.
    """
    key = digest(source)
    if file.is_file() and (files is None or files.is_dir()):
        try:
            found = json.loads(file.read_text())
            if found["key"] == key and isinstance(found["result"], dict):
                log.info("%s: found before", file.stem)
                return dict(found["result"])
        except (ValueError, KeyError, TypeError):
            log.warning("%s: damaged; it is found again", file)
    result = make()
    write_json(file, {"key": key, "result": result})
    return result


def digest(source: Any) -> str:
    """A short hash of something that JSON can hold."""
    text = json.dumps([VERSION, source], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def stamp(path: Path) -> list[Any]:
    """What tells one state of a file, or of a folder of files, from another."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    found = [(file, file.stat()) for file in files if file.is_file()]
    return [str(path.resolve()), *([f.name, s.st_size, s.st_mtime_ns] for f, s in found)]
