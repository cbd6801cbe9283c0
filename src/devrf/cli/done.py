"""What a pipeline has scored and filmed is not done again.

A step notes what it was done with (checkpoint, settings, data, logger, version) and the files it
wrote. It is done as long as all of these are as they were. A step that is asked for by name is done
again.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

import devrf
from devrf.checkpoints.checkpoint_file import digest_of
from devrf.cli.context import RunContext
from devrf.cli.run_lock import PLACE
from devrf.errors import DevrfError
from devrf.system.files import write_json

log = logging.getLogger(__name__)

# The config group that decides what a step makes, by step; other steps are always done.
DECIDES = {"evaluate": "evaluation", "render": "video"}
NOTE = "done.json"  # in the folder of the lock
# Where these steps write.
RESULTS = ("metrics.json", "frames.csv", "images/*", "videos/*")
# Keys of data that are places for further files.
PLACES = {"flow_cache", "export"}


def done(run: RunContext, step: str) -> list[str]:
    """The files of a step that need not be done again; none where it must be."""
    noted, present = _notes(run.folder).get(step), _done_with(run, step)
    if noted is None or present is None:
        return []
    files: list[str] = noted["files"]
    there = all((run.folder / name).is_file() for name in files)
    return files if there and noted["with"] == present else []


@contextmanager
def noting(run: RunContext, step: str) -> Iterator[None]:
    """Note that the step was done, once the block has ended, and the files it wrote."""
    if step not in DECIDES:
        yield
        return
    before = _stamps(run.folder)
    yield
    after = _stamps(run.folder)
    files = [name for name, stamp in after.items() if before.get(name) != stamp]
    notes = _notes(run.folder) | {step: {"with": _done_with(run, step), "files": files}}
    write_json(run.folder / PLACE / NOTE, notes)


def say_done(step: str, files: list[str]) -> None:
    """Say in a line that a step is left out."""
    log.info("%s: done already (%s); stage=%s does it again", step, ", ".join(files), step)


def _done_with(run: RunContext, step: str) -> dict[str, Any] | None:
    """What decides a step's results, as plain data; None without a checkpoint."""
    try:
        checkpoint = digest_of(run.checkpoint())
    except (DevrfError, OSError):
        return None
    group = DECIDES[step]
    parts = {key: OmegaConf.to_container(run.config[key], resolve=True) for key in ("data", group)}
    data = parts["data"]
    assert isinstance(data, dict)
    for place in PLACES & data.keys():
        del data[place]
    if data.get("root") is not None:
        data["root"] = str(Path(data["root"]).resolve())
    logger = OmegaConf.select(run.config, "logger._target_")
    return {"checkpoint": checkpoint, "version": devrf.__version__, "logger": logger, **parts}


def _notes(folder: Path) -> dict[str, Any]:
    try:
        notes: dict[str, Any] = json.loads((folder / PLACE / NOTE).read_text())
    except (OSError, ValueError):
        return {}
    return notes


def _stamps(folder: Path) -> dict[str, int]:
    """When each result was written, in nanoseconds, by its path in the run's folder."""
    paths = sorted(path for pattern in RESULTS for path in folder.glob(pattern))
    return {path.relative_to(folder).as_posix(): path.stat().st_mtime_ns for path in paths}
