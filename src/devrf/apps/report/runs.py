"""Finished and failed runs below a folder, read from the files that they left."""

from __future__ import annotations

import io
import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from devrf.apps.settings import REHEARSAL
from devrf.errors import DevrfError
from devrf.system.files import read_record, utf8_path

# What every run has; further columns are what its file holds, by dotted name.
COLUMNS = (
    "folder",
    "status",
    "scene",
    "method",
    "protocol",
    "at_rest",
    "error",
    "mistake",
    "train_seconds",
    "peak_gpu_gb",
    "dynamic.psnr",
    "dynamic.ssim",
    "dynamic.lpips",
    "run.device",
    "run.overrides",
    "run.seed",
    "run.checkpoint",
    "run.date",
    "path",
)
DEFAULT_METHOD = "devrf"
DEFAULT_PROTOCOL = "two_stage"


@dataclass(frozen=True)
class Collection:
    """What was found below a folder.

    Attributes:
        runs: a row for each scored run: ``COLUMNS`` and everything in its ``metrics.json``.
            ``folder`` is relative to the one searched; ``train_seconds`` and ``peak_gpu_gb`` (GiB)
            are of the whole run, NaN unless every stage recorded its own.
        failures: a row for each failed job; ``mistake``: whether the user can correct it.
        skipped: a line for each file that could not be read, with the reason, and one for
            rehearsals.
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
    rehearsals = 0
    for walked, inner, _ in os.walk(folder):
        inner[:] = sorted((name for name in inner if not name.startswith(".")), key=_natural)
        place = Path(walked)
        rehearsals += (place / REHEARSAL).is_file()
        name = folder.resolve().name if place == folder else place.relative_to(folder).as_posix()
        for file, status, read in (
            (place / "failure.json", "failed", _failed),
            (place / "metrics.json", "finished", _finished),
        ):
            if not file.is_file():
                continue
            try:
                utf8_path(place)  # or no table could be printed
                record = read(json.loads(read_record(file)))
            except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
                skipped.append(f"{file}: skipped; it is damaged, or not as devrf writes it")
            except DevrfError as error:
                skipped.append(str(error))
            else:
                records[status].append({**record, "folder": name, "path": place, "status": status})
    if rehearsals:
        skipped.append(f"{rehearsals} of the folders hold a rehearsal, which is no run")
    runs = _frame(records["finished"])
    failures = _frame(records["failed"])
    return Collection(folder, runs, failures, tuple(skipped))


def number(value: Any) -> float:
    """A recorded value as a number; NaN where it is none, or not finite."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and math.isfinite(value) else math.nan


def metric_over_time(path: Path, metric: str) -> pd.Series:
    """A column of a run's ``frames.csv`` by time in [0, 1]: means over the dynamic test views.

    Empty where the run has no such values.
    """
    try:
        file = path / "frames.csv"
        text = read_record(file) if file.is_file() else b""  # a pipe would be waited for
        frames = pd.read_csv(io.BytesIO(text))
        frames = frames[frames["capture"] == "dynamic"].dropna(subset=metric)
        return frames.astype({"time": float, metric: float}).groupby("time")[metric].mean()
    except (OSError, ValueError, KeyError):
        return pd.Series(dtype=float)


def _natural(name: str) -> tuple[int, int, str]:
    """Order in which 2_robot comes before 10_robot."""
    head = name.partition("_")[0]
    return (0, int(head), name) if head.isdecimal() else (1, 0, name)


def _finished(metrics: dict[str, Any]) -> dict[str, Any]:
    at_rest = metrics.get("at_rest", False)
    static = metrics.get("static", {})
    # Other protocols may have no stage of their own for the static capture.
    stages = [] if at_rest else [metrics.get("dynamic", {})]
    if at_rest or static.get("seconds") is not None or metrics["protocol"] == DEFAULT_PROTOCOL:
        stages.append(static)
    frame = pd.DataFrame(stages, columns=["seconds", "peak_gpu_gb"], dtype=object).map(number)
    seconds = frame["seconds"].sum(skipna=False)
    memory = frame["peak_gpu_gb"].max(skipna=False)
    head = {key: metrics[key] for key in ("scene", "method")}
    return metrics | head | {"at_rest": at_rest, "train_seconds": seconds, "peak_gpu_gb": memory}


def _failed(failure: dict[str, Any]) -> dict[str, Any]:
    setup = {key: failure[key] for key in ("choices", "overrides", "seed")}
    error = " ".join(failure["error"].split())
    head = {"scene": failure["scene"], "error": error, "mistake": failure["mistake"]}
    return {**head, "run": setup}


def _frame(records: list[dict[str, Any]]) -> pd.DataFrame:
    flat = [pd.json_normalize(record).to_dict("records")[0] for record in records]
    names = dict.fromkeys([*COLUMNS, *(name for record in flat for name in record)])
    # Values are objects, so that numbers are written as they were read.
    frame = pd.DataFrame(flat, columns=list(names), dtype=object)
    return frame.assign(**{"run.overrides": [row.get("run.overrides") or [] for row in flat]})
