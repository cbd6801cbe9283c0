"""Mean scores, rows and provenance, read back."""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path

import pytest
import torch

import devrf
from devrf.artifacts.records import git_revision, mean_scores, provenance, write_frames
from devrf.evaluation.held_out import HeldOutView


def view(name: str, time: float, psnr: float, **further: float | None) -> HeldOutView:
    image = torch.zeros(2, 2, 3)
    return HeldOutView(name, time, image, image, psnr, 0.5, 9.0, further, compared=image)


def test_means_are_over_what_is_known() -> None:
    views = [
        view("a", 0.0, 20.0, depth_error=0.5, flow_error=None, lpips=None),
        view("b", 1.0, 31.0, depth_error=0.25, flow_error=3.0, lpips=None),
    ]
    assert mean_scores(views) == {
        "psnr": 25.5,
        "ssim": 0.5,
        "depth_error": 0.375,
        "flow_error": 3.0,
        "lpips": None,
    }


def test_frames_read_back(tmp_path: Path) -> None:
    path = tmp_path / "run" / "frames.csv"
    rest = [view("r, 0", 0.0, 20.0, depth_error=0.5, flow_error=None)]
    moving = [view(f"m{k}", k / 2, 20.0 + k, depth_error=None, flow_error=1.5) for k in range(3)]
    write_frames(path, {"static": rest, "dynamic": moving})
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["capture"] for row in rows] == ["static"] + ["dynamic"] * 3
    at_rest = {"capture": "static", "name": "r, 0", "time": "0", "psnr": "20", "ssim": "0.5"}
    assert rows[0] == {**at_rest, "rest_pose_psnr": "9", "depth_error": "0.5", "flow_error": ""}
    assert [float(row["time"]) for row in rows[1:]] == [0.0, 0.5, 1.0]
    assert [float(row["psnr"]) for row in rows[1:]] == [20.0, 21.0, 22.0]
    assert {(row["depth_error"], row["flow_error"]) for row in rows[1:]} == {("", "1.5")}


def test_provenance_is_plain_data() -> None:
    found = provenance(12, torch.device("cpu"))
    assert json.loads(json.dumps(found)) == found
    assert {"lightning", "python", "git", "peak_host_gb"} < set(found)
    assert found["devrf"] == devrf.__version__ and found["torch"] == torch.__version__
    assert found["device"] and found["parameters"] == 12
    assert found["date"].endswith("+00:00")


def test_the_revision_is_that_of_a_checkout(tmp_path: Path) -> None:
    assert git_revision(tmp_path) is None

    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
        command = ["git", *identity, *arguments]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        git("init")
    except FileNotFoundError:
        pytest.skip("git is not installed")
    assert git_revision(tmp_path) is None  # nothing committed yet
    (tmp_path / "file").write_text("one")
    git("add", "file")
    git("commit", "-m", "one")
    git("tag", "v1")
    head = git("rev-parse", "HEAD")
    assert git_revision(tmp_path) == head
    (tmp_path / "file").write_text("two")
    assert git_revision(tmp_path) == f"{head}-dirty"
