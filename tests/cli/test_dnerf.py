"""D-NeRF from the command line: trained, scored, filmed and resumed like any method."""

from __future__ import annotations

import json

import pytest

SMALL = (
    "method=dnerf",
    "experiment=peer_small",
    "ray_stage.schedule.iterations=20",
    "ray_stage.schedule.rays=64",
    "ray_stage.model.settings.width=8",
    "ray_stage.model.settings.deformation_width=8",
    "ray_stage.model.settings.steps=16",
    "ray_stage.model.settings.occupancy_side=8",
    "video.frames=3",
    "video.height=40",
    "trainer=cpu",
)


@pytest.mark.parametrize("protocol", ["joint", "two_stage", "dynamic"])
def test_a_protocol_trains_scores_and_films(devrf, tmp_path, tiny_data, protocol):
    done = devrf(*SMALL, *tiny_data, f"protocol={protocol}", "hydra.run.dir=run")
    assert done.status == 0, done.err
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (found["method"], found["protocol"]) == ("dnerf", protocol)
    assert 3 < found["dynamic"]["psnr"] < 40 and 3 < found["static"]["psnr"] < 40
    assert {"rest_pose_psnr", "seconds", "iterations", "checkpoint_mb"} <= set(found["dynamic"])
    assert (tmp_path / "run" / "videos" / "held_out.mp4").stat().st_size > 1000
    names = {path.stem for path in (tmp_path / "run" / "checkpoints").glob("*.ckpt")}
    assert names == {"two_stage": {"canonical", "deformation"}}.get(protocol, {protocol})
    # Whatever was learned is not learned again.
    again = devrf(*SMALL, *tiny_data, f"protocol={protocol}", "hydra.run.dir=run")
    assert again.status == 0 and "learned already" in again.out


def test_a_forward_facing_scene(devrf, tmp_path, tiny_facing):
    done = devrf(*SMALL, *tiny_facing, "protocol=joint", "hydra.run.dir=run")
    assert done.status == 0, done.err
    assert (tmp_path / "run" / "videos" / "spiral.mp4").is_file()


def test_it_has_a_folder_of_its_own(devrf, tmp_path, tiny_data):
    done = devrf(*SMALL, *tiny_data, "protocol=joint", "stage=joint")
    assert done.status == 0, done.err
    assert (tmp_path / "outputs/robot/peer_small-dnerf-joint/checkpoints/joint.ckpt").is_file()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["protocol=joint", "stage=canonical"], "stage: expected one of pipeline, joint,"),
        (["+ray_stage.loss.elastic=1"], "ray_stage.loss: dnerf has no term 'elastic'"),
        (["ray_stage.model.settings.sampling=random"], "expected one of hierarchical, occupancy"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(devrf, tiny_data, asked, said):
    done = devrf(*SMALL, *tiny_data, *asked)
    assert done.status == 2 and said in done.err and done.err.count("\n") == 1


def test_it_is_exported_as_points(devrf, tmp_path, tiny_data):
    here = ("hydra.run.dir=run", "trainer=cpu")
    assert devrf(*SMALL, *tiny_data, "protocol=joint", "stage=joint", *here).status == 0
    refused = devrf("stage=export", *here)
    assert refused.status == 2 and refused.err.count("\n") == 1
    assert "method=dnerf is exported as coloured points" in refused.err
    done = devrf("stage=export", "export.format=ply", "export.points=20", *here)
    assert (done.status, done.err) == (0, "")
    assert len(list((tmp_path / "run" / "export" / "points").glob("frame_*.ply"))) == 3
