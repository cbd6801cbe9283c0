"""Reads hostile files in a process of its own: ``read_hostile.py`` < [[name, reader, path], …].

Writes a line of JSON for each: its name, the message it was refused with (null: it was read),
seconds, and by how many bytes the most memory that the process ever held grew.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from devrf.errors import DevrfError
from devrf.scenes.array_files import read_numbers
from devrf.scenes.flow_cache import load_flow
from devrf.scenes.flow_files import read_flow_file
from devrf.scenes.images import load_images
from devrf.scenes.json_files import read_json
from devrf.scenes.transforms import read_transforms

READERS: dict[str, Callable[[Path], Any]] = {
    "json": lambda path: read_json(path, TypeAdapter(dict[str, Any]), "it is tested"),
    "transforms": lambda path: read_transforms(path, path.parent),
    "npy": lambda path: read_numbers(path, "cameras"),
    "flow": lambda path: read_flow_file(path, width=6, height=4),
    "cache": lambda path: load_flow(path, "0" * 64, (2, 4, 6)) or refuse(),
    "images": lambda path: load_images(sorted(path.iterdir()), 1),
    "many images": lambda path: load_images([path] * 10_000, 1),
}


def refuse() -> None:
    """A damaged cache is no error; for the table it counts as refused."""
    raise DevrfError("no cache")


def most_memory() -> int:
    """The most bytes that this process ever held."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def main() -> None:
    """Read what standard input lists."""
    for name, reader, path in json.load(sys.stdin):
        before, start, message = most_memory(), time.perf_counter(), None
        try:
            READERS[reader](Path(path))
        except DevrfError as error:
            message = str(error)
        took = time.perf_counter() - start
        print(json.dumps([name, message, took, most_memory() - before]), flush=True)


if __name__ == "__main__":
    main()
