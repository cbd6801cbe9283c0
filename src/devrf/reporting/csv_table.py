"""Everything that is known of every run as a CSV table, a row a run."""

from __future__ import annotations

import csv
from pathlib import Path

from devrf.reporting.runs import Failure, Run, Value
from devrf.reporting.table import Table
from devrf.system.files import atomic_write

FIRST = ("folder", "status", "scene", "row", "error", "mistake", "train_seconds", "peak_gpu_gb")


def write_csv(path: Path, table: Table) -> None:
    """Write a row for each run and each failure.

    ``train_seconds`` and ``peak_gpu_gb`` are the tables' Time and GPU; the other columns are what
    ``metrics.json`` holds, by dotted name. What is not known is empty.
    """
    labels = {run.folder: row.label for row in table.rows for run in row.runs}
    records = [
        *(_of_run(run, labels.get(run.folder)) for run in table.found.runs),
        *map(_of_failure, table.found.failures),
    ]
    names = dict.fromkeys([*FIRST, *(name for record in records for name in record)])
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(names))
        writer.writeheader()
        writer.writerows(
            {name: _text(value) for name, value in record.items()} for record in records
        )


def _of_run(run: Run, label: str | None) -> dict[str, Value]:
    own: dict[str, Value] = {
        "folder": run.name,
        "status": "finished",
        "row": label,
        "train_seconds": run.seconds,
        "peak_gpu_gb": run.gpu_gb,
    }
    return {**own, **run.record}


def _of_failure(failure: Failure) -> dict[str, Value]:
    choices = failure.setup.choices or {}
    return {
        "folder": failure.name,
        "status": "failed",
        "scene": failure.scene,
        "error": failure.error,
        "mistake": failure.mistake,
        **{f"run.choices.{group}": option for group, option in choices.items()},
        "run.overrides": " ".join(failure.setup.overrides),
        "run.seed": failure.setup.seed,
    }


def _text(value: Value) -> Value:
    return str(value).lower() if isinstance(value, bool) else value
