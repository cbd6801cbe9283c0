"""Times that no training view has are scored apart, and reported."""

from __future__ import annotations

import json

import pytest


def test_a_scene_with_held_out_times_is_scored_and_reported(devrf, tmp_path, tiny):
    held_out = ("data.novel_times_every=2", "evaluation.metrics=[psnr_masked]")
    for stage in ("canonical", "deformation", "evaluate"):
        done = devrf(*tiny, *held_out, f"stage={stage}", "hydra.run.dir=runs/one")
        assert (done.status, done.err) == (0, "")
    assert "novel times: psnr" in done.out
    dynamic = json.loads((tmp_path / "runs" / "one" / "metrics.json").read_text())["dynamic"]
    novel = dynamic["novel_times"]
    # Of three frames the one in the middle is not learned from.
    assert set(novel) == {"psnr", "ssim", "psnr_masked", "rest_pose_psnr", "images"}
    known = dynamic["training_times"]
    assert (novel["images"], known["images"]) == (1, 2)
    assert dynamic["psnr"] == pytest.approx((novel["psnr"] + 2 * known["psnr"]) / 3, abs=1e-4)
    done = devrf("stage=report", "report.runs=runs", "hydra.run.dir=report")
    assert done.status == 0 and "PSNR at novel times" in done.out
