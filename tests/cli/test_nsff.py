"""NSFF from the command line: trained, scored and filmed like any method."""

from __future__ import annotations

import json

import pytest

TINY = (
    "method=nsff",
    "experiment=peer_small",
    "ray_stage.schedule.iterations=2",
    "ray_stage.schedule.rays=32",
    "ray_stage.schedule.iterations_per_step=1",
    "ray_stage.model.settings.width=8",
    "ray_stage.model.settings.depth=2",
    "ray_stage.model.settings.steps=16",
    "ray_stage.model.settings.samples=8",
    "ray_stage.model.settings.occupancy_side=8",
    "video.frames=3",
    "video.height=40",
    "trainer=cpu",
)


@pytest.mark.parametrize(
    ("protocol", "scene", "film"),
    [("joint", "tiny_facing", "spiral"), ("dynamic", "tiny_data", "held_out")],
)
def test_a_protocol_trains_scores_and_films(devrf, tmp_path, request, protocol, scene, film):
    done = devrf(
        *TINY, *request.getfixturevalue(scene), f"protocol={protocol}", "hydra.run.dir=run"
    )
    assert done.status == 0, done.err
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (found["method"], found["protocol"]) == ("nsff", protocol)
    assert 3 < found["dynamic"]["psnr"] < 40 and 3 < found["static"]["psnr"] < 40
    assert {"rest_pose_psnr", "seconds", "iterations", "checkpoint_mb"} <= set(found["dynamic"])
    assert (tmp_path / "run" / "videos" / f"{film}.mp4").stat().st_size > 1000
    picture = devrf("hydra.run.dir=run", "stage=still", "still.time=0.37", "still.height=20")
    assert picture.status == 0, picture.err


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ([], "protocol: method=nsff does not learn by protocol=two_stage; give protocol=joint or"),
        (["protocol=joint", "ray_stage.model.settings.blend=w"], "expected one of v, additive"),
        (["protocol=joint", "ray_stage.model.settings.sampling=hierarchical"],
         "expected one of stratified, occupancy"),
        (["protocol=joint", "+ray_stage.loss.elastic=1"], "ray_stage.loss: nsff has no term"),
        (["protocol=joint", "ray_stage.model.settings.warmup.min_frames=99"],
         "warmup.min_frames: expected 1 … max_frames (30), not 99"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_said_in_one_line(devrf, tiny_data, asked, said):
    done = devrf(*TINY, *tiny_data, *asked)
    assert done.status == 2 and said in done.err and done.err.count("\n") == 1
