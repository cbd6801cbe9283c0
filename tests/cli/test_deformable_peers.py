"""D-NeRF's relatives from the command line: by every protocol, in every profile."""

from __future__ import annotations

import json

import pytest

FILM = ("trainer=cpu", "video.frames=2", "video.height=20")
SETTINGS = "ray_stage.model.settings"
SMALL = (
    "experiment=peer_small",
    "ray_stage.schedule.iterations=4",
    "ray_stage.schedule.rays=64",
    f"{SETTINGS}.width=8",
    f"{SETTINGS}.warp_width=8",
    f"{SETTINGS}.steps=16",
    f"{SETTINGS}.occupancy_side=8",
)


@pytest.mark.parametrize("method", ["nerfies", "hypernerf"])
@pytest.mark.parametrize("protocol", ["joint", "two_stage", "dynamic"])
def test_a_protocol_trains_scores_and_films(devrf, tmp_path, tiny_data, method, protocol):
    scene = (*tiny_data, *FILM)
    asked = (f"method={method}", *SMALL, *scene, f"protocol={protocol}", "hydra.run.dir=run")
    done = devrf(*asked, "ray_stage.loss.elastic=1e-3")
    assert done.status == 0, done.err
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (found["method"], found["protocol"]) == (method, protocol)
    assert 3 < found["dynamic"]["psnr"] < 40 and 3 < found["static"]["psnr"] < 40
    assert found["run"]["settings"][f"{SETTINGS}.sampling"] == "occupancy"
    assert (tmp_path / "run" / "videos" / "held_out.mp4").stat().st_size > 500
    names = {path.stem for path in (tmp_path / "run" / "checkpoints").glob("*.ckpt")}
    assert names == {"two_stage": {"canonical", "deformation"}}.get(protocol, {protocol})


def test_a_forward_facing_scene(devrf, tmp_path, tiny_facing):
    done = devrf(
        "method=hypernerf", *SMALL, *tiny_facing, *FILM, "protocol=joint", "hydra.run.dir=run"
    )
    assert done.status == 0, done.err
    assert (tmp_path / "run" / "videos" / "spiral.mp4").is_file()


@pytest.mark.parametrize("method", ["dnerf", "nerfies", "hypernerf"])
@pytest.mark.parametrize("profile", ["fast", "paper"])
def test_sizes_for_a_gpu_take_two_steps_on_a_cpu(devrf, tmp_path, tiny_data, method, profile):
    done = devrf(
        f"method={method}",
        f"experiment=peer_{profile}",
        "protocol=joint",
        "stage=joint",
        "ray_stage.schedule.iterations=2",
        "ray_stage.schedule.rays=8",
        f"{SETTINGS}.occupancy_side=16",
        *tiny_data,
        *FILM,
        "hydra.run.dir=run",
    )
    assert done.status == 0, done.err
    assert (tmp_path / "run" / "checkpoints" / "joint.ckpt").is_file()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["method=nerfies", "ray_stage.loss.temporal=1"], "no such key"),
        (["method=nerfies", f"{SETTINGS}.separate_coarse=true"], "sampling=occupancy has no"),
        (["method=hypernerf", f"{SETTINGS}.slicing=line"], "expected one of surface, plane"),
        (["method=hypernerf", f"{SETTINGS}.sampling=random"], "hierarchical, occupancy"),
        (["method=hypernerf", "protocol.freeze=some"], "protocol.freeze: expected"),
        (["method=devrf", "protocol.freeze=false"], "protocol.freeze: method=devrf has stages"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(devrf, tiny_data, asked, said):
    done = devrf("experiment=peer_small", *tiny_data, *FILM, *asked)
    assert done.status == 2 and said in done.err and done.err.count("\n") == 1, done.err
