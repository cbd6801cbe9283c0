"""Neural Volumes from the command line: trained, scored, filmed and resumed like any method."""

from __future__ import annotations

import json

import pytest

SMALL = (
    "method=neural_volumes",
    "experiment=peer_small",
    "ray_stage.schedule.iterations=2",
    "ray_stage.schedule.rays=64",
    "ray_stage.schedule.iterations_per_step=1",
    "ray_stage.model.settings.code=4",
    "ray_stage.model.settings.encoder_views=2",
    "ray_stage.model.settings.encoder_size=[16,16]",
    "ray_stage.model.settings.encoder_channels=[4,4]",
    "ray_stage.model.settings.encoder_width=8",
    "ray_stage.model.settings.template_channels=[8,8,8]",
    "ray_stage.model.settings.warp_side=4",
    "ray_stage.model.settings.warp_width=4",
    "ray_stage.model.settings.step=0.2",
    "ray_stage.model.settings.occupancy_side=8",
    "video.frames=3",
    "video.height=40",
    "trainer=cpu",
)


@pytest.mark.parametrize("protocol", ["joint", "dynamic"])
def test_a_protocol_trains_scores_and_films(devrf, tmp_path, tiny_data, protocol):
    done = devrf(*SMALL, *tiny_data, f"protocol={protocol}", "hydra.run.dir=run")
    assert done.status == 0, done.err
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (found["method"], found["protocol"]) == ("neural_volumes", protocol)
    assert 3 < found["dynamic"]["psnr"] < 40 and 3 < found["static"]["psnr"] < 40
    assert found["dynamic"]["iterations"] == 2 and found["dynamic"]["rest_pose_psnr"] > 3
    assert (tmp_path / "run" / "videos" / "held_out.mp4").stat().st_size > 1000
    again = devrf(*SMALL, *tiny_data, f"protocol={protocol}", "hydra.run.dir=run")
    assert again.status == 0 and "learned already" in again.out


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["protocol=two_stage"], "neural_volumes does not learn by protocol=two_stage; give"),
        (["data.train_views=1"], "expected 2 fixed training cameras with an image of every frame"),
        (["data.surroundings=room"], "robot_room has no end; give images with alpha masks"),
        (["ray_stage.model.settings.warp=rigid"], "expected one of conv, affine"),
        (
            ["ray_stage.schedule.times_per_batch=0"],
            "ray_stage.schedule.times_per_batch: expected at least 1",
        ),
        (["ray_stage.schedule.rays_without_hull=0"], "rays_without_hull: expected at least 1"),
        (["ray_stage.model.settings.warp_side=5"], "warp_side: expected a power of two, not 5"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(devrf, tiny_data, asked, said):
    done = devrf(*SMALL, *tiny_data, "protocol=joint", *asked)
    assert done.status == 2 and said in done.err and done.err.count("\n") == 1
