"""Folders as runs leave them, without running anything."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

Ran = Callable[..., Path]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """The folder that the runs of a test lie in."""
    folder = tmp_path / "runs"
    folder.mkdir()
    return folder


@pytest.fixture
def ran(runs: Path) -> Ran:
    """``ran(name, …)``: leaves a finished run in ``runs/name`` and returns its folder."""

    def write(
        name: str,
        scene: str = "robot",
        *,
        scores: Mapping[str, float | None] | None = None,
        seconds: tuple[float | None, float | None] = (10.0, 20.0),
        gpu: tuple[float | None, float | None] = (None, None),
        ablation: str | None = "full",
        choices: Mapping[str, str | None] | None = None,
        overrides: Sequence[str] = (),
        seed: int | None = 0,
        frames: Sequence[tuple[float, float]] = (),
        **of_run: Any,
    ) -> Path:
        sections: dict[str, Any] = {
            "scene": scene,
            "canonical": {"psnr": 33.0, "seconds": seconds[0], "peak_gpu_gb": gpu[0]},
            "deformation": {
                "psnr": 29.0,
                "ssim": 0.95,
                "lpips": None,
                **(scores or {}),
                "seconds": seconds[1],
                "peak_gpu_gb": gpu[1],
            },
            "run": {
                "device": "a processor",
                "git": "0123456789abcdef",
                "parameters": 1000,
                "choices": {"ablation": ablation, "logger": "csv", **(choices or {})},
                "overrides": list(overrides),
                "seed": seed,
                **of_run,
            },
        }
        folder = runs / name
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps(sections))
        if frames:
            with (folder / "frames.csv").open("w", newline="") as file:
                table = csv.writer(file)
                table.writerow(["capture", "name", "time", "psnr", "ssim"])
                table.writerow(["static", "at rest", 0, 40, 0.9])
                table.writerows(["dynamic", f"m{t}", t, psnr, ""] for t, psnr in frames)
        return folder

    return write


@pytest.fixture
def failed(runs: Path) -> Ran:
    """``failed(name, error, …)``: leaves the record of a failed job in ``runs/name``."""

    def write(name: str, error: str, **further: Any) -> Path:
        record = {
            "scene": "robot",
            "choices": {"ablation": "base"},
            "overrides": ["ablation=base"],
            "seed": 0,
            "error": error,
            "mistake": True,
            "date": "2026-01-01T00:00:00+00:00",
        }
        folder = runs / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "failure.json").write_text(json.dumps({**record, **further}))
        return folder

    return write
