"""Pictures of another program are scored and compared as runs are."""

from __future__ import annotations

import json
import shutil

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
    assert (again["scene"], again["method"]) == ("robot", "Splats (pictures)")
    for section in ("static", "dynamic"):
        assert again[section]["psnr"] == pytest.approx(own[section]["psnr"], abs=0.02)
        assert {"depth_error", "rest_pose_psnr"}.isdisjoint(again[section])
    report = devrf("stage=report")
    assert report.status == 0 and "Splats (pictures)" in report.out and "Ours" in report.out
    lacking = devrf(*tiny, "stage=evaluate", "evaluation.predictions=outputs/run/images")
    assert lacking.status == 2 and lacking.err.count("\n") == 1 and "pictures" in lacking.err
