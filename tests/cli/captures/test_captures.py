"""Eight captures of the kinds that strangers bring: inspected, learned, reported by their path."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

# The reader that each capture is recognised for, and whether anything moves in it.
FOUND = {
    "lego": ("inward", False),
    "fern": ("forward", False),
    "fox": ("nerfstudio", False),
    "phone": ("nerfstudio", False),
    "hand": ("forward", True),
    "windmill": ("dycheck", True),
    "garden": ("colmap", False),
    "salmon": ("neural_3d_video", True),
}


@pytest.fixture(scope="module")
def place(
    tmp_path_factory: pytest.TempPathFactory, captures: dict[str, Callable[[Path], None]]
) -> Path:
    """A working folder with the eight captures in it."""
    folder = tmp_path_factory.mktemp("strangers")
    for name, write in captures.items():
        write(folder / name)
    return folder


@pytest.fixture(scope="module")
def learned(
    place: Path, devrf_in: Callable[..., Any], short: tuple[str, ...]
) -> dict[str, tuple[Any, Any]]:
    """What ``stage=inspect`` and the pipeline said of each, and the runs below ``outputs``."""
    quick = (*short, "schedule.canonical.visual_hull_init=false", "video.frames=3")
    return {
        name: (
            devrf_in(place, "stage=inspect", f"data.root={name}", "trainer=cpu"),
            devrf_in(place, f"data.root={name}", *quick),
        )
        for name in FOUND
    }


def metrics_of(place: Path, name: str) -> dict[str, Any]:
    """The scores of a capture's run."""
    content: dict[str, Any] = json.loads(
        (place / "outputs" / name / "quickstart" / "metrics.json").read_text()
    )
    return content


@pytest.mark.parametrize("name", FOUND)
def test_a_capture_needs_no_flag_beside_its_folder(
    name: str, place: Path, learned: dict[str, tuple[Any, Any]]
) -> None:
    reader, moves = FOUND[name]
    inspected, run = learned[name]
    assert (inspected.status, inspected.err) == (run.status, run.err) == (0, "")
    assert f"(data={reader})" in inspected.out and f"(data={reader})" in run.out
    assert ("one moment: the scene is at rest" in inspected.out) is not moves
    assert (f"{name} is at rest: canonical, evaluate, render" in run.out) is not moves
    metrics = metrics_of(place, name)
    assert metrics["scene"] == name and metrics["run"]["choices"]["data"] == reader
    assert ("dynamic" in metrics) is moves and metrics["static"]["psnr"] > 0
    assert (place / "outputs" / name / "quickstart/videos/held_out.mp4").stat().st_size > 0


def test_the_stage_at_rest_alone_is_scored_alike(
    place: Path,
    learned: dict[str, tuple[Any, Any]],
    devrf_in: Callable[..., Any],
    short: tuple[str, ...],
) -> None:
    """What COLMAP has posed: stage=canonical and evaluate, or the pipeline."""
    quick = (*short, "schedule.canonical.visual_hull_init=false", "hydra.run.dir=alone")
    for stage in ("canonical", "evaluate"):
        done = devrf_in(place, "data.root=garden", *quick, f"stage={stage}")
        assert (done.status, done.err) == (0, "")
    alone = json.loads((place / "alone/metrics.json").read_text())
    for score in ("psnr", "ssim"):
        assert alone["static"][score] == metrics_of(place, "garden")["static"][score]


def test_they_are_in_one_report(
    place: Path, learned: dict[str, tuple[Any, Any]], devrf_in: Callable[..., Any]
) -> None:
    reported = devrf_in(place, "stage=report")
    assert (reported.status, reported.err) == (0, "")
    for name, (_, moves) in FOUND.items():
        psnr = metrics_of(place, name)["dynamic" if moves else "static"]["psnr"]
        assert name in reported.out and f"{psnr:.2f}" in reported.out
    assert "At rest, scored on held-out images of the static set: " in reported.out
