"""Finished and failed runs below a folder, read back from what they wrote."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from devrf.errors import DevrfError

FINISHED, FAILED, FRAMES = "metrics.json", "failure.json", "frames.csv"

Value = str | int | float | bool | None


@dataclass(frozen=True)
class Setup:
    """How a run was told to go.

    Attributes:
        choices: the option chosen of each config group; None where that was not recorded.
        overrides: what was given on the command line.
        seed: None where that was not recorded.
    """

    choices: Mapping[str, str | None] | None
    overrides: tuple[str, ...]
    seed: int | None


@dataclass(frozen=True)
class Run:
    """A run that was scored.

    Attributes:
        folder: where it lives.
        name: that folder as seen from the one that was searched.
        scene: the scene's name.
        setup: how it was told to go.
        record: everything in its ``metrics.json``, by dotted name: ``deformation.psnr``. Lists
            are joined by spaces.
    """

    folder: Path
    name: str
    scene: str
    setup: Setup
    record: Mapping[str, Value]

    @property
    def moving(self) -> bool:
        """Whether its deformation was scored, not only its scene at rest."""
        return self.number("deformation.psnr") is not None

    @property
    def seconds(self) -> float | None:
        """Wall clock of optimisation, both stages; None unless both are known."""
        stages = self._of_stages("seconds")
        return None if stages is None else sum(stages)

    @property
    def gpu_gb(self) -> float | None:
        """Peak GPU memory of both stages, GiB; None unless both are known."""
        stages = self._of_stages("peak_gpu_gb")
        return None if stages is None else max(stages)

    def number(self, name: str) -> float | None:
        """A number of the record; None where there is none, or none that is finite."""
        value = self.record.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        return float(value) if math.isfinite(value) else None

    def text(self, name: str) -> str | None:
        """A text of the record, if there is one."""
        value = self.record.get(name)
        return value if isinstance(value, str) else None

    def over_time(self, metric: str) -> tuple[tuple[float, float], ...]:
        """(time in [0, 1], metric) of the held-out moving images, in order of time.

        The mean where several views share a time; empty where ``frames.csv`` has none.
        """
        found: dict[float, list[float]] = {}
        try:
            with (self.folder / FRAMES).open(newline="", encoding="utf-8") as file:
                for row in csv.DictReader(file):
                    if row.get("capture") == "dynamic" and row.get(metric):
                        found.setdefault(float(row["time"]), []).append(float(row[metric]))
        except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError, csv.Error):
            return ()
        return tuple((time, mean(found[time])) for time in sorted(found))

    def _of_stages(self, name: str) -> tuple[float, float] | None:
        rest, moving = (self.number(f"{stage}.{name}") for stage in ("canonical", "deformation"))
        return None if rest is None or moving is None else (rest, moving)


@dataclass(frozen=True)
class Failure:
    """A job of a sweep that failed.

    Attributes:
        name: its folder as seen from the one that was searched.
        scene: the scene's name; None where it failed before that was known.
        setup: how it was told to go.
        error: why, in one line.
        mistake: whether the user can put it right; else it is a fault of the program, and
            ``run.log`` has its traceback. None where that was not recorded.
    """

    name: str
    scene: str | None
    setup: Setup
    error: str
    mistake: bool | None


@dataclass(frozen=True)
class Collection:
    """What was found below a folder.

    Attributes:
        folder: the one that was searched.
        runs: those that were scored, by name.
        failures: those that failed, by name.
        skipped: files that could not be read, each with its reason in one line.
    """

    folder: Path
    runs: tuple[Run, ...]
    failures: tuple[Failure, ...]
    skipped: tuple[str, ...]


def collect(folder: Path) -> Collection:
    """Find every run below ``folder``, at any depth, ``folder`` itself included.

    A run is a folder with a ``metrics.json``: one that is under way or was interrupted has none.
    Hidden folders are passed over.

    Raises:
        DevrfError: no such folder.
    """
    if not folder.is_dir():
        raise DevrfError(f"report.runs: no folder {folder}; give the folder that holds the runs")
    runs: list[Run] = []
    failures: list[Failure] = []
    skipped: list[str] = []
    for place in _folders(folder):
        name = folder.resolve().name if place == folder else place.relative_to(folder).as_posix()
        try:
            if (place / FAILED).is_file():
                failures.append(_failure(place / FAILED, name))
            if (place / FINISHED).is_file():
                runs.append(_run(place / FINISHED, name))
        except DevrfError as error:
            skipped.append(str(error))
    return Collection(folder, tuple(runs), tuple(failures), tuple(skipped))


def _folders(folder: Path) -> Iterator[Path]:
    for place, inner, _ in os.walk(folder):
        inner[:] = sorted((name for name in inner if not name.startswith(".")), key=_natural)
        yield Path(place)


def _natural(name: str) -> tuple[int, int, str]:
    """Order in which 2_robot comes before 10_robot."""
    head = name.partition("_")[0]
    return (0, int(head), name) if head.isdecimal() else (1, 0, name)


def _run(path: Path, name: str) -> Run:
    values = _object(path)
    scene, ran = values.get("scene"), values.get("run", {})
    stages = [values.get(stage, {}) for stage in ("canonical", "deformation")]
    if not isinstance(scene, str) or not all(isinstance(v, dict) for v in (ran, *stages)):
        raise DevrfError(f"{path}: skipped; not the metrics of a devrf run")
    return Run(path.parent, name, scene, _setup(path, ran), dict(_flat(values)))


def _failure(path: Path, name: str) -> Failure:
    values = _object(path)
    scene, error, mistake = (values.get(key) for key in ("scene", "error", "mistake"))
    if not isinstance(error, str) or not isinstance(scene, str | None):
        raise DevrfError(f"{path}: skipped; not the record of a devrf run that failed")
    mistake = mistake if isinstance(mistake, bool) else None
    return Failure(name, scene, _setup(path, values), " ".join(error.split()), mistake)


def _object(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise DevrfError(f"{path}: skipped; damaged, or not to be read") from None
    if not isinstance(values, dict):
        raise DevrfError(f"{path}: skipped; expected a JSON object")
    return values


def _setup(path: Path, values: Mapping[str, Any]) -> Setup:
    choices, overrides, seed = (values.get(key) for key in ("choices", "overrides", "seed"))
    known = (
        isinstance(choices, dict | None)
        and all(isinstance(option, str | None) for option in (choices or {}).values())
        and isinstance(overrides, list | None)
        and all(isinstance(override, str) for override in overrides or ())
        and isinstance(seed, int | None)
    )
    if not known:
        raise DevrfError(f"{path}: skipped; choices, overrides or seed not as devrf writes them")
    return Setup(choices, tuple(overrides or ()), seed)


def _flat(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Value]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{path}{key}.")
        else:
            listed = isinstance(value, list)
            yield f"{path}{key}", " ".join(map(str, value)) if listed else value
