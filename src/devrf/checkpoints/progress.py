"""Progress files, and the random state in them.

A progress file holds all that a stage needs to go on exactly where it was left
(:mod:`devrf.engine.stage`).
"""

from __future__ import annotations

import random
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from typing_extensions import TypedDict

from devrf.system.plain_data import Count, Factor, Line, Share


class Progress(TypedDict):
    """Progress of a stage: name, length of its schedule, position and size of batches.

    ``phase`` is the first iteration of the present phase; ``phase_state`` is the part of its state
    that does not follow from schedule and model; ``random`` is the result of :func:`rng_state`.
    """

    stage: Line
    total: Count
    iteration: Count
    iterations_done: Count
    seed: Count
    num_rollbacks: Count
    lr_scale: Share
    schedule_scale: Factor
    ended_early: bool
    batch_share: Share
    largest_share: Share
    phase: Count | None
    phase_state: dict[str, Any]
    random: dict[str, Any]


def progress_file(folder: Path, stage: str, iteration: int) -> Path:
    """The file of a stage's progress at an iteration."""
    return folder / f"{stage}-progress-{iteration}.ckpt"


def progress_files(folder: Path, stage: str) -> list[Path]:
    """The progress files of a stage, the furthest first."""
    files = {
        int(match.group(1)): path
        for path in folder.glob(f"{stage}-progress-*.ckpt")
        if (match := re.fullmatch(rf"{stage}-progress-(\d+)\.ckpt", path.name))
    }
    return [files[iteration] for iteration in sorted(files, reverse=True)]


def rng_state(device: torch.device) -> dict[str, Any]:
    """The state of everything that a run on ``device`` draws random numbers from, as plain data."""
    numpy = np.random.get_state(legacy=False)
    assert isinstance(numpy, dict)
    key = torch.from_numpy(numpy["state"]["key"].astype(np.int64))
    states: dict[str, Any] = {
        "python": random.getstate(),
        "numpy": {**numpy, "state": {"key": key, "pos": int(numpy["state"]["pos"])}},
        "torch": torch.get_rng_state(),
    }
    if device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(device)
    return states


def set_rng_state(states: dict[str, Any], device: torch.device) -> None:
    """Restore the state that :func:`rng_state` gave."""
    random.setstate(states["python"])
    numpy = states["numpy"]
    key = numpy["state"]["key"].numpy().astype(np.uint32)
    np.random.set_state({**numpy, "state": {**numpy["state"], "key": key}})
    torch.set_rng_state(states["torch"])
    if device.type == "cuda" and "cuda" in states:
        torch.cuda.set_rng_state(states["cuda"], device)
