"""Mean scores, rows and provenance, read back."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess

import pytest
import torch

from devrf.apps.records import (
    dynamic_scores,
    git_revision,
    in_words,
    mean_scores,
    provenance,
    scores_by_section,
    shown_sections,
    tracked_scores,
    write_frames,
)
from devrf.checkpoints.checkpoint import CheckpointMetadata
from devrf.evaluation.held_out import HeldOutView
from devrf.geometry.clock import FrameClock

METRICS = ["psnr", "ssim", "rest_pose_psnr", "depth_error", "flow_error"]


def view(name, time, psnr, **further):
    image = torch.zeros(2, 2, 3)
    planes = {"depth": image[..., 0], "opacity": image[..., 0]}
    return HeldOutView(name, time, image, image, psnr, 0.5, 9.0, further, compared=image, **planes)


def test_means_are_over_what_is_known():
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


def test_each_section_has_what_its_own_stage_took():
    took = {"canonical": (8.0, 80), "deformation": (20.0, 60)}
    records = {name: {"seconds": s, "iterations": n} for name, (s, n) in took.items()}
    learned = CheckpointMetadata("robot", "", "deformation", {}, records=records)
    frames = {"static": [view("a", 0.0, 20.0)], "dynamic": [view("b", 1.0, 31.0)]}
    found = scores_by_section(frames, FrameClock((0.0, 1.0)), learned, "canonical", 1.0)
    assert (found["static"]["seconds"], found["dynamic"]["seconds"]) == (8.0, 20.0)
    assert (found["dynamic"]["iterations"], found["deformation"]) == (60, found["dynamic"])


def test_times_that_no_training_view_has_are_scored_apart():
    times = (0.0, 20.0), (0.25, 30.0), (0.5, 22.0), (1.0, 40.0)
    views = [view("a", time, psnr) for time, psnr in times]
    found = dynamic_scores(views, FrameClock((0.0, 0.5)))
    assert (found["psnr"], found["rest_pose_psnr"]) == (28.0, 9.0)
    assert (found["training_times"]["psnr"], found["training_times"]["images"]) == (21.0, 2)
    # Between two frames, and beyond the last.
    expected = {"psnr": 35.0, "ssim": 0.5, "rest_pose_psnr": 9.0, "images": 2}
    assert found["novel_times"] == expected
    # Where all times are novel that section is of all images.
    alone = dynamic_scores(views[1:2], FrameClock((0.0, 0.5)))
    assert alone["psnr"] == alone["novel_times"]["psnr"] == 30.0
    assert "training_times" not in alone


def test_numbers_are_rounded_for_people():
    values = {"psnr": 33.42981, "lpips": None, "iterations": 123456, "seconds": 12345.678}
    assert in_words(values) == "psnr 33.43, iterations 123456, seconds 12346"


def test_validation_scores_are_no_test_scores():
    sections = {"dynamic": {"psnr": 20.0}, "validation": {"psnr": 21.0, "images": 3}}
    expected = {"test/dynamic/psnr": 20.0, "validation/psnr": 21.0, "validation/images": 3}
    assert tracked_scores(sections) == expected
    assert shown_sections(sections) == sections


def test_frames_read_back(tmp_path):
    path = tmp_path / "run" / "frames.csv"
    rest = [view("r, 0", 0.0, 20.0, depth_error=0.5, flow_error=None)]
    moving = [view("=m()", 0.5, 21.0, depth_error=None, flow_error=1.5)]
    write_frames(path, {"static": rest, "dynamic": moving})
    with path.open(newline="") as file:
        assert list(csv.reader(file)) == [
            ["capture", "name", "time", *METRICS],
            ["static", "r, 0", "0", "20", "0.5", "9", "0.5", ""],
            ["dynamic", "'=m()", "0.5", "21", "0.5", "9", "", "1.5"],
        ]


def test_provenance_is_plain_data():
    found = provenance(torch.device("cpu"))
    assert json.loads(json.dumps(found)) == found
    assert found["device"] and found["date"].endswith("+00:00")


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_the_revision_is_that_of_a_checkout(tmp_path):
    def git(*arguments):
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", *arguments]
        return subprocess.check_output(command, cwd=tmp_path, text=True).strip()

    assert git_revision(tmp_path) is None
    git("init")
    assert git_revision(tmp_path) is None  # nothing committed yet
    (tmp_path / "file").write_text("one")
    git("add", "file")
    git("-c", "commit.gpgsign=false", "commit", "-m", "one")
    git("tag", "v1")
    head = git("rev-parse", "HEAD")
    index = (tmp_path / ".git" / "index").stat().st_ino
    os.utime(tmp_path / "file", (0, 0))  # what git would renew its index for
    assert git_revision(tmp_path) == head
    assert (tmp_path / ".git" / "index").stat().st_ino == index, "a lock was taken"
    (tmp_path / "file").write_text("two")
    assert git_revision(tmp_path) == f"{head}-dirty"
