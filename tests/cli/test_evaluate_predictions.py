"""Pictures of another program are scored and compared as runs are."""

from __future__ import annotations

import json
import shutil

import imageio.v3 as iio
import numpy as np
import pytest


def test_a_runs_own_pictures_come_back_as_another_programs(devrf, tmp_path, tiny, trained):
    shutil.copytree(trained[0], tmp_path / "outputs" / "run")
    asked = (*tiny, "stage=evaluate", "hydra.run.dir=outputs/run", "evaluation.pictures=true")
    assert devrf(*asked).status == 0
    folder = "evaluation.predictions=outputs/run/images/held_out"
    scored = devrf(*tiny, "stage=evaluate", folder, "evaluation.program=Splats")
    assert (scored.status, scored.err) == (0, "")
    assert "Splats (pictures), dynamic: psnr" in scored.out
    own = json.loads((tmp_path / "outputs" / "run" / "metrics.json").read_text())
    found = tmp_path / "outputs" / "robot" / "Splats-pictures"
    again = json.loads((found / "metrics.json").read_text())
    assert {path.name for path in found.iterdir()} >= {"frames.csv", "images", "metrics.json"}
    # The film shows what that of the run does, but for depth.
    films = [iio.imread(f / "videos" / "held_out.mp4") for f in (tmp_path / "outputs/run", found)]
    assert films[0].shape == films[1].shape
    differences = np.abs(films[0].astype(float) - films[1])[:, 18:, :100].mean(axis=(1, 2, 3))
    assert differences.max() < 4
    assert (again["scene"], again["method"]) == ("robot", "Splats (pictures)")
    for section in ("static", "dynamic"):
        assert again[section]["psnr"] == pytest.approx(own[section]["psnr"], abs=0.02)
        assert {"depth_error", "rest_pose_psnr", "pck_t"}.isdisjoint(again[section])
    # What moves is what the scene says, for both.
    assert own["run"]["motion_masks"] == again["run"]["motion_masks"] == "exact"
    for metric, rounding in (("psnr_moving", 0.02), ("ssim_moving", 1e-3), ("flicker", 1e-3)):
        assert again["dynamic"][metric] == pytest.approx(own["dynamic"][metric], abs=rounding)
    assert own["dynamic"]["psnr_moving"] < own["dynamic"]["psnr"]
    assert 0 < own["dynamic"]["pck_t"] <= 1 and own["static"]["psnr_moving"] is None
    assert devrf("stage=render", "hydra.run.dir=outputs/run", "video.motion_masks=true").status == 0
    masks = sorted((tmp_path / "outputs" / "run" / "images" / "motion_masks").iterdir())
    pictures = sorted((tmp_path / "outputs" / "run" / "images" / "held_out" / "dynamic").iterdir())
    assert [mask.name for mask in masks] == [picture.name for picture in pictures]
    assert iio.imread(masks[-1]).shape == iio.imread(pictures[-1]).shape
    scored = devrf(*tiny, "stage=evaluate", folder, "evaluation.program=Splats")
    assert (scored.status, scored.err) == (0, "")  # pictures may be scored again
    report = devrf("stage=report")
    assert report.status == 0 and "Splats (pictures)" in report.out and "Ours" in report.out
    lacking = devrf(*tiny, "stage=evaluate", "evaluation.predictions=outputs/run/images")
    assert lacking.status == 2 and lacking.err.count("\n") == 1 and "pictures" in lacking.err


def test_the_results_of_a_learned_run_stay(devrf, tmp_path, tiny, trained):
    run = tmp_path / "outputs" / "run"
    shutil.copytree(trained[0], run)
    (tmp_path / "pictures").mkdir()
    kept = {path: path.read_bytes() for path in (run / "metrics.json", run / "frames.csv")}
    asked = (*tiny, "evaluation.predictions=pictures", "hydra.run.dir=outputs/run")
    needs = "of a run that has learned; evaluation.predictions needs a folder of its own"
    for _ in range(2):
        refused = devrf(*asked, "stage=evaluate")
        assert refused.status == 2 and refused.err.count("\n") == 1 and needs in refused.err
        shutil.rmtree(run / "checkpoints", ignore_errors=True)  # the scores alone say so
    refused = devrf(*tiny, "evaluation.predictions=pictures")
    assert refused.status == 2 and "score pictures by stage=evaluate" in refused.err
    assert {path: path.read_bytes() for path in kept} == kept
