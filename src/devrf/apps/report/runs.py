"""Finished and failed runs below a folder, read from the files that they left."""

from __future__ import annotations

import csv
import json
import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from annotated_types import Len

from devrf.apps.settings import REHEARSAL
from devrf.errors import DevrfError
from devrf.system.files import UNREADABLE, read_record, utf8_path, walk
from devrf.system.plain_data import validate
from devrf.system.printed import shown

log = logging.getLogger(__name__)

SKIPPED = "%s: skipped; it is damaged, or not as devrf writes it"
# The most values of a record, letters of a name, letters of a text or items of a list; the largest
# number.
MOST = 1000
# The most names of all values: a report has a cell for each in each run.
MOST_COLUMNS = 5000
LONGEST_NAME = 255
LONGEST = 10_000
LARGEST = 1e9
_Name = Annotated[str, Len(1, LONGEST_NAME)]
_Text = Annotated[str, Len(0, LONGEST)]
_Plain = _Text | bool | int | float | Annotated[list[Any], Len(0, LONGEST)] | None
# Settings that make scenes of their own.
PRIORS = "run.settings.priors"
SECONDS = "run.settings.schedule.seconds"
# Columns of every run; further columns are entries of its file, by dotted name.
COLUMNS = (
    *("folder", "status", "scene", "method", "protocol", "at_rest", "error", "mistake"),
    *("train_seconds", "peak_gpu_gb", "dynamic.psnr", "dynamic.ssim", "dynamic.lpips"),
    *("run.device", "run.overrides", "run.seed", "run.checkpoint", "run.date", "run.benchmark"),
    *("run.lpips_network", "run.motion_masks", "run.train_views", PRIORS, SECONDS),
    "path",
)
# Kinds of values that a report builds on; the last ones are mappings, and no values.
KINDS: dict[str, Any] = {
    **dict.fromkeys(("scene", "method", "protocol"), _Name),
    **dict.fromkeys(("at_rest", "mistake"), bool),
    "error": _Text,
    "dynamic.psnr": int | float | None,
    "run.overrides": Annotated[list[_Text], Len(0, MOST)] | None,
    "run.image_size": Annotated[list[int], Len(2, 2)] | None,
    **dict.fromkeys(("run.device", "run.checkpoint", "run.date", "run.git"), _Text | None),
    **dict.fromkeys(("run.devrf", "run.fingerprint", "run.lpips_network"), _Text | None),
    **dict.fromkeys(("run.motion_masks", "run.benchmark"), _Text | None),
    **dict.fromkeys(("static", "dynamic", "run", "choices"), dict),
}
DEFAULT_METHOD = "devrf"
DEFAULT_PROTOCOL = "two_stage"


@dataclass(frozen=True)
class Collection:
    """The runs below a folder.

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
    names: set[str] = set()
    rehearsals = 0
    for child, inner, _ in walk(folder):
        inner.sort(key=_natural)
        rehearsals += (child / REHEARSAL).is_file()
        name = folder.resolve().name if child == folder else child.relative_to(folder).as_posix()
        for file, status, read in (
            (child / "failure.json", "failed", _failed),
            (child / "metrics.json", "finished", _finished),
        ):
            if not file.is_file():
                continue
            try:
                utf8_path(child)  # or no table could be printed
                record = read(_flat(json.loads(read_record(file))))
                if len(names | record.keys()) > MOST_COLUMNS:
                    raise ValueError("names of its own")
                names |= record.keys()
            except (OSError, *UNREADABLE):
                skipped.append(shown(SKIPPED % file))
            except DevrfError as error:
                skipped.append(str(error))
            else:
                record |= {"folder": shown(name), "path": child, "status": status}
                records[status].append(record)
    if rehearsals:
        skipped.append(f"{rehearsals} of the folders hold a rehearsal, which is no run")
    runs = _frame(records["finished"])
    failures = _frame(records["failed"])
    return Collection(folder, runs, failures, tuple(skipped))


def number(value: Any) -> float:
    """A recorded value as a number; NaN where it is none, not finite, or like none of a run."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and abs(value) < LARGEST else math.nan


def metric_over_time(path: Path, metric: str) -> pd.Series:
    """A column of a run's ``frames.csv`` by time in [0, 1]: means over the dynamic test views.

    It is empty if the run has no such values.
    """
    file = path / "frames.csv"
    curve = pd.DataFrame({"time": [], metric: []})
    try:
        if file.is_file():  # a pipe would be waited for
            # pandas would take hours for many columns of one name, DictReader for absent cells.
            table = csv.reader(read_record(file).decode().splitlines())
            columns = next(table, [])
            rows = (dict(zip(columns, row, strict=False)) for row in table if row)
            pairs = [(r["time"], r[metric]) for r in rows if r["capture"] == "dynamic"]
            known = [(float(time), float(value)) for time, value in pairs if value]
            curve = pd.DataFrame(known, columns=["time", metric])
    except (OSError, ValueError, KeyError, TypeError, csv.Error):
        log.warning(SKIPPED, file)
    return curve[curve[metric].abs() < LARGEST].groupby("time")[metric].mean()


def _natural(name: str) -> tuple[int, int, str]:
    """Order in which 2_robot comes before 10_robot."""
    head = name.partition("_")[0]
    return (0, int(head), name) if head.isdecimal() else (1, 0, name)


def _flat(record: dict[str, Any], above: str = "") -> dict[str, Any]:
    """The values of a record by dotted names, their texts as a terminal may have them.

    Raises:
        ValueError: they are not as in a record, too many or too long.
    """
    values: dict[str, Any] = {}
    for key, value in record.items():
        name = shown(above + key)
        if isinstance(value, dict):
            values |= _flat(value, f"{name}.")
        else:
            value = validate(KINDS.get(name, _Plain), value)
            values[name] = shown(value) if isinstance(value, str) else value
        if len(name) > LONGEST_NAME or len(values) > MOST:
            raise ValueError(name)
    return values


def _finished(metrics: dict[str, Any]) -> dict[str, Any]:
    at_rest = metrics.get("at_rest", False)
    # Other protocols may have no stage of their own for the static capture.
    stages = [] if at_rest else ["dynamic"]
    own = metrics.get("static.seconds") is not None or metrics["protocol"] == DEFAULT_PROTOCOL
    stages += ["static"] * (at_rest or own)
    seconds, memory = (
        [number(metrics.get(f"{stage}.{key}")) for stage in stages]
        for key in ("seconds", "peak_gpu_gb")
    )
    head = {key: metrics[key] for key in ("scene", "method", "protocol")}
    # NaN unless all are known.
    took = {"train_seconds": sum(seconds), "peak_gpu_gb": max(memory) + 0 * sum(memory)}
    return metrics | head | {"at_rest": at_rest} | took


def _failed(failure: dict[str, Any]) -> dict[str, Any]:
    setup = {f"run.{key}": failure[key] for key in failure if key.startswith("choices.")}
    setup |= {f"run.{key}": failure[key] for key in ("overrides", "seed")}
    return {key: failure[key] for key in ("scene", "error", "mistake")} | setup


def _frame(records: list[dict[str, Any]]) -> pd.DataFrame:
    names = dict.fromkeys([*COLUMNS, *(name for record in records for name in record)])
    # Values are objects, so that numbers are written as they were read.
    frame = pd.DataFrame(records, columns=list(names), dtype=object)
    return frame.assign(**{"run.overrides": [row.get("run.overrides") or [] for row in records]})
