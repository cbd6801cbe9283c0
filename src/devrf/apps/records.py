"""A run's numbers: mean scores, a row for each held-out image, and the run's provenance."""

from __future__ import annotations

import csv
import math
import platform
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import fmean
from typing import Any

import lightning
import torch

import devrf
from devrf.checkpoints.checkpoint import GIVEN_REST, CheckpointMetadata
from devrf.checkpoints.file_metadata import OWN_REST
from devrf.evaluation.held_out import HeldOutView
from devrf.evaluation.objective import TRAINING, VALIDATION
from devrf.geometry.clock import FrameClock
from devrf.scenes.scene import Scene
from devrf.system.files import atomic_write
from devrf.system.memory import peak_host_memory
from devrf.system.printed import csv_cell

# Held-out images of the dynamic capture at times that a training view has, and at others.
OF_TIMES = ("training_times", "novel_times")
# Figures of the way in which iterations were carried out.
EXECUTION = ("peak_reserved_gb",)


def mean_scores(views: Sequence[HeldOutView]) -> dict[str, float | None]:
    """Means of each metric over the held-out images that have it, to five digits; else None.

    ``rest_pose_psnr``, which is of the dynamic capture only, is left out.
    """
    means: dict[str, float | None] = {}
    for name in views[0].scores:
        values = [view.scores[name] for view in views]
        finite = [value for value in values if value is not None and not math.isnan(value)]
        means[name] = round(fmean(finite), 5) if finite else None
    means.pop("rest_pose_psnr", None)
    return means


def dynamic_scores(views: Sequence[HeldOutView], clock: FrameClock) -> dict[str, Any]:
    """Means over held-out images in motion, ``rest_pose_psnr`` among them.

    If some are at times that no training view has (by its ``clock``), ``novel_times`` has the means
    over these and their number ``images``, ``training_times`` the same over the others.
    """
    novel = [view for view in views if not clock.knows(view.time)]
    seen_times = [view for view in views if clock.knows(view.time)]
    scores: dict[str, Any] = _with_rest_pose(views)
    for name, group in zip(OF_TIMES, (seen_times, novel), strict=True):
        if novel and group:
            scores[name] = {**_with_rest_pose(group), "images": len(group)}
    return scores


def scores_by_section(
    frames: Mapping[str, Sequence[HeldOutView]],
    clock: FrameClock,
    metadata: CheckpointMetadata,
    rest: str | None,
    checkpoint_mb: float,
) -> dict[str, Any]:
    """The sections of ``metrics.json``: mean scores, and figures of training.

    Sections ``static`` and ``dynamic`` of ``frames`` stand under the names of their stages, too.
    ``rest`` is the stage that learned the scene at rest. If one stage learned all (None), its
    training stands in the dynamic section, where there is one.
    """

    def training(stage: str) -> dict[str, Any]:
        record = metadata.records.get(stage, {})
        return {name: record.get(name) for name in TRAINING}

    static: dict[str, Any] = mean_scores(frames["static"])
    sections = {"static": static}
    last = metadata.stage
    if rest is not None or "dynamic" not in frames:
        sections["static"] = sections[rest or last] = static | training(rest or last)
    if "dynamic" in frames:
        sections["dynamic"] = dynamic_scores(frames["dynamic"], clock) | training(last)
        if rest is not None:
            sections[last] = sections["dynamic"]
    sections["dynamic" if "dynamic" in frames else "static"]["checkpoint_mb"] = checkpoint_mb
    return sections


def shown_sections(sections: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """The scores of each set without those of some times, which are sections of their own."""
    names = ("static", "dynamic", VALIDATION)
    captures = {name: sections[name] for name in names if name in sections}
    of_times = {key: row[key] for row in captures.values() for key in OF_TIMES if key in row}
    return {
        name: {key: value for key, value in row.items() if key not in OF_TIMES}
        for name, row in (captures | of_times).items()
    }


def tracked_scores(sections: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Scores by trackers' names: ``test/dynamic/psnr``, ``validation/psnr``, unlike any curve's."""
    return {
        f"{'' if section == VALIDATION else 'test/'}{section}/{key}": value
        for section, row in sections.items()
        for key, value in row.items()
        if value is not None and key not in OF_TIMES
    }


def _with_rest_pose(views: Sequence[HeldOutView]) -> dict[str, float | None]:
    values = [view.rest_pose_psnr for view in views if view.rest_pose_psnr is not None]
    return {**mean_scores(views), "rest_pose_psnr": round(fmean(values), 4)}


def write_frames(path: Path, captures: Mapping[str, Sequence[HeldOutView]]) -> None:
    """Write the :func:`frame_rows` of some captures as CSV."""
    rows = frame_rows(captures)
    columns = dict.fromkeys(column for row in rows for column in row)
    with atomic_write(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        # pandas would take 30 MB of every run.
        table = csv.DictWriter(file, [*columns], lineterminator="\n")
        table.writeheader()
        for row in rows:
            cells = {k: csv_cell(v) if isinstance(v, str) else v for k, v in row.items()}
            table.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in cells.items()})


def frame_rows(
    captures: Mapping[str, Sequence[HeldOutView]],
) -> list[dict[str, str | float | None]]:
    """A row for each held-out image of each capture: capture, name, time, every metric."""
    return [
        {"capture": capture, "name": view.name, "time": view.time, **view.scores}
        for capture, group in captures.items()
        for view in group
    ]


def data_record(scene: Scene) -> dict[str, Any]:
    """The data of a scene: kind, frames, views; size, number and exposure of held-out images.

    The size is the commonest.
    """
    test = scene.dynamic.test
    commonest = test.cameras.of_commonest_size()
    # Half of each held-out image has told its exposure, and is not scored.
    halved = {} if test.exposure_mask is None else {"exposure": "equal"}
    frames = scene.clock.frames_of(scene.dynamic.train.times)
    return {
        "kind": scene.kind,
        "image_size": [commonest.width, commonest.height],
        "frames": len(scene.clock) if scene.moves else None,
        # A camera that moves is one view, however many images it took.
        "train_views": int(frames.bincount().max()) if scene.moves else None,
        "test_frames": len(test),
        **halved,
    }


def learning_record(metadata: CheckpointMetadata, stages: Sequence[str]) -> dict[str, Any]:
    """The record of the ``stages``: settings, seconds, and the memory that torch held.

    ``settings`` are those that decided what was learned, by config key, in all stages;
    ``frame_psnr`` the training PSNR of frames 1, 2, … in dB, where frames were learned singly.
    """
    settings: dict[str, Any] = {}
    for of_stage in (*metadata.earlier_configs.values(), metadata.training_config):
        settings |= of_stage
    records = {name: metadata.records.get(name, {}) for name in stages}
    return {
        **({"seed": settings["seed"]} if "seed" in settings else {}),
        "settings": {k: settings[k] for k in sorted(settings) if k not in (OWN_REST, GIVEN_REST)},
        "fingerprint": metadata.fingerprint,
        "wall_seconds": {name: record.get("wall_seconds") for name, record in records.items()},
        "execution": {
            n: {key: record.get(key) for key in EXECUTION} for n, record in records.items()
        },
        "frame_psnr": {
            n: record["frame_psnr"] for n, record in records.items() if "frame_psnr" in record
        },
    }


def provenance(device: torch.device) -> dict[str, Any]:
    """The origin of numbers, as plain data: versions, ``device``, memory in GiB, UTC date."""
    return {
        "devrf": devrf.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "lightning": lightning.__version__,
        "device": device_name(device),
        "git": git_revision(),
        "peak_host_gb": peak_host_memory(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def device_name(device: torch.device) -> str:
    """The GPU's name, or the processor's."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def git_revision(root: Path | None = None) -> str | None:
    """The commit of a checkout, ``-dirty`` where files were changed; None outside one.

    ``root`` None: the folder that holds ``src/devrf``.
    """
    root = Path(devrf.__file__).resolve().parents[2] if root is None else root
    if not (root / ".git").exists():  # a folder above may be another project's checkout
        return None
    # Without a lock, which a run that is killed would leave to every later commit.
    command = ["git", "--no-optional-locks", "status", "--porcelain=v2", "--branch"]
    command += ["--untracked-files=no"]
    try:
        result = subprocess.run(
            command, cwd=root, capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    head, *others = result.stdout.splitlines()
    commit = head.removeprefix("# branch.oid ")
    changed = any(not line.startswith("#") for line in others)
    return None if commit == "(initial)" else commit + "-dirty" * changed


def in_words(values: Mapping[str, Any]) -> str:
    """``name value, name value, …`` on one line, rounded, without lists and unknown values."""
    return ", ".join(
        f"{key} {rounded(value)}"
        for key, value in values.items()
        if value is not None and not isinstance(value, list)
    )


def rounded(value: Any) -> str:
    """A number with four digits, whole numbers with all of theirs, for people; others as text."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if 1000 <= abs(value) < 1e15 else f"{value:.4g}"
