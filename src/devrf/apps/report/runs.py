"""Finished and failed runs below a folder, read from the files that they left."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from pydantic import BaseModel, ConfigDict, ValidationError

from devrf.errors import DevrfError

# What every run has; further columns are what its file holds, by dotted name.
COLUMNS = (
    *("folder", "status", "scene", "method", "protocol", "at_rest", "error", "mistake"),
    *("train_seconds", "peak_gpu_gb", "dynamic.psnr", "dynamic.ssim", "dynamic.lpips"),
    *("run.device", "run.overrides", "run.seed", "run.checkpoint", "run.date", "path"),
)
DEFAULT_METHOD, DEFAULT_PROTOCOL = "devrf", "two_stage"
Section = dict[str, Any]


class _Setup(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")
    choices: dict[str, str | None] | None = None
    overrides: list[str] | None = None
    seed: int | None = None
    device: str | None = None


class _Metrics(BaseModel):
    """What is checked of ``metrics.json``."""

    model_config = ConfigDict(strict=True, extra="allow")
    scene: str
    method: str
    protocol: str
    at_rest: bool = False
    run: _Setup = _Setup()
    static: Section = {}
    dynamic: Section = {}


class _Failure(_Setup):
    """What is checked of ``failure.json``."""

    error: str
    scene: str | None = None
    mistake: bool | None = None


@dataclass(frozen=True)
class Collection:
    """What was found below a folder.

    Attributes:
        runs: a row for each scored run: ``COLUMNS`` and everything in its ``metrics.json``.
            ``folder`` is relative to the one searched; ``train_seconds`` and ``peak_gpu_gb`` (GiB)
            are of the whole run, NaN unless every stage recorded its own.
        failures: a row for each failed job; ``mistake``: whether the user can correct it.
        skipped: a line for each file that could not be read, with the reason.
    """

    folder: Path
    runs: pd.DataFrame
    failures: pd.DataFrame
    skipped: tuple[str, ...]


def collect(folder: Path) -> Collection:
    """Find every ``metrics.json`` and ``failure.json`` below ``folder``, but for hidden folders.

    Raises:
        DevrfError: no such folder.
    """
    if not folder.is_dir():
        raise DevrfError(f"report.runs: no folder {folder}; give the folder that holds the runs")
    records: dict[str, list[dict[str, Any]]] = {"finished": [], "failed": []}
    skipped: list[str] = []
    for walked, inner, _ in os.walk(folder):
        inner[:] = sorted((name for name in inner if not name.startswith(".")), key=_natural)
        place = Path(walked)
        name = folder.resolve().name if place == folder else place.relative_to(folder).as_posix()
        for file, status, read in (
            (place / "failure.json", "failed", _failed),
            (place / "metrics.json", "finished", _finished),
        ):
            if not file.is_file():
                continue
            try:
                record = read(file.read_bytes())
            except (OSError, ValidationError) as error:
                skipped.append(f"{file}: skipped; {_reason(error)}")
            else:
                records[status].append({**record, "folder": name, "path": place, "status": status})
    runs, failures = _frame(records["finished"]), _frame(records["failed"])
    return Collection(folder, runs, failures, tuple(skipped))


def number(value: Any) -> float:
    """A recorded value as a number; NaN where it is none, or not finite."""
    known = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if known and math.isfinite(value) else math.nan


def metric_over_time(path: Path, metric: str) -> pd.Series:
    """A column of a run's ``frames.csv`` by time in [0, 1]: means over the dynamic test views.

    Empty where the run has no such values.
    """
    try:
        frames = pd.read_csv(path / "frames.csv")
        frames = frames[frames["capture"] == "dynamic"].dropna(subset=metric)
        return frames.astype({"time": float, metric: float}).groupby("time")[metric].mean()
    except (OSError, ValueError, KeyError):
        return pd.Series(dtype=float)


def _natural(name: str) -> tuple[int, int, str]:
    """Order in which 2_robot comes before 10_robot."""
    head = name.partition("_")[0]
    return (0, int(head), name) if head.isdecimal() else (1, 0, name)


def _finished(content: bytes) -> dict[str, Any]:
    metrics = _Metrics.model_validate_json(content)
    values = metrics.model_dump(exclude_unset=True) | {"at_rest": metrics.at_rest}
    # Other protocols may have no stage of their own for the static capture.
    stages = [] if metrics.at_rest else [metrics.dynamic]
    of_static = metrics.at_rest or metrics.static.get("seconds") is not None
    if of_static or metrics.protocol == DEFAULT_PROTOCOL:
        stages.append(metrics.static)
    frame = pd.DataFrame(stages, columns=["seconds", "peak_gpu_gb"], dtype=object).map(number)
    values["train_seconds"] = frame["seconds"].sum(skipna=False)
    values["peak_gpu_gb"] = frame["peak_gpu_gb"].max(skipna=False)
    return values


def _failed(content: bytes) -> dict[str, Any]:
    failure = _Failure.model_validate_json(content)
    setup = failure.model_dump(include={"choices", "overrides", "seed"}, exclude_none=True)
    error = " ".join(failure.error.split())
    return {"scene": failure.scene, "error": error, "mistake": failure.mistake, "run": setup}


def _reason(error: OSError | ValidationError) -> str:
    if isinstance(error, OSError) or error.errors()[0]["type"] == "json_invalid":
        return "damaged, or not to be read"
    first = error.errors()[0]
    place = ".".join(map(str, first["loc"])) or "the file"
    return f"not as devrf writes it ({place}: {first['msg'].lower()})"


def _frame(records: list[dict[str, Any]]) -> pd.DataFrame:
    flat = [pd.json_normalize(record).to_dict("records")[0] for record in records]
    names = dict.fromkeys([*COLUMNS, *(name for record in flat for name in record)])
    # Of type object, so that numbers are written as they were read.
    frame = pd.DataFrame(flat, columns=list(names), dtype=object)
    return frame.assign(**{"run.overrides": [row.get("run.overrides") or [] for row in flat]})
