"""Every other method from the command line: trained, scored, filmed, exported like DeVRF."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
import trimesh

from devrf import methods
from devrf.methods.ray_stage import RayStage

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
SETTINGS = "ray_stage.model.settings"
NARROW = (f"{SETTINGS}.width=8", f"{SETTINGS}.steps=16", f"{SETTINGS}.occupancy_side=8")
# Fine enough that a hull leaves some of the box empty.
HULL = f"{SETTINGS}.occupancy_side=16"
SMALL = {
    "dnerf": (*NARROW, f"{SETTINGS}.deformation_width=8"),
    "nerfies": (*NARROW, f"{SETTINGS}.warp_width=8", "ray_stage.loss.elastic=1e-3"),
    "hypernerf": (*NARROW, f"{SETTINGS}.warp_width=8", "ray_stage.loss.elastic=1e-3"),
    "nsff": (*NARROW, f"{SETTINGS}.depth=2", f"{SETTINGS}.samples=8"),
    "tineuvox": (f"{SETTINGS}.width=8", f"{SETTINGS}.side=8", HULL),
    "kplanes": (*NARROW, HULL, f"{SETTINGS}.resolution=4", f"{SETTINGS}.channels=2"),
    "gaussians": (f"{SETTINGS}.width=8", f"{SETTINGS}.hull_side=16"),
    "neural_volumes": (
        f"{SETTINGS}.code=4",
        f"{SETTINGS}.encoder_views=2",
        f"{SETTINGS}.encoder_size=[16,16]",
        f"{SETTINGS}.encoder_channels=[4,4]",
        f"{SETTINGS}.encoder_width=8",
        f"{SETTINGS}.template_channels=[8,8,8]",
        f"{SETTINGS}.warp_channels=[4,4]",
        f"{SETTINGS}.step=0.2",
        f"{SETTINGS}.occupancy_side=8",
    ),
}
FILM = ("trainer=cpu", "video.frames=1", "video.height=20", "hydra.run.dir=run")
FILM += ("evaluation.metrics=[]", "~callbacks.training_curve")
SHORT = ("ray_stage.schedule.iterations=4", "ray_stage.schedule.rays=64", *FILM)


@pytest.mark.parametrize(
    ("method", "protocol", "scene"),
    [
        ("dnerf", "two_stage", "tiny_data"),
        ("nerfies", "joint", "tiny_data"),
        ("hypernerf", "two_stage", "tiny_facing"),
        ("nsff", "dynamic", "tiny_facing"),
        ("neural_volumes", "dynamic", "tiny_data"),
        ("tineuvox", "two_stage", "tiny_data"),
        ("kplanes", "joint", "tiny_data"),
        ("gaussians", "two_stage", "tiny_data"),
        ("tineuvox", "dynamic", "tiny_facing"),
    ],
)
def test_a_protocol_trains_scores_and_films(devrf, tmp_path, request, method, protocol, scene):
    asked = (f"method={method}", "experiment=peer_small", *SMALL[method], *SHORT)
    asked += (*request.getfixturevalue(scene), f"protocol={protocol}")
    done = devrf(*asked)
    assert done.status == 0, done.err
    run = tmp_path / "run"
    found = json.loads((run / "metrics.json").read_text())
    assert (found["method"], found["protocol"]) == (method, protocol)
    assert 3 < found["dynamic"]["psnr"] < 40 and 3 < found["static"]["psnr"] < 40
    assert {"rest_pose_psnr", "seconds", "iterations", "checkpoint_mb"} <= set(found["dynamic"])
    ring = "spiral" if scene == "tiny_facing" else "orbit"
    assert {path.stem for path in (run / "videos").iterdir()} == {"held_out", ring}
    names = {path.stem for path in (run / "checkpoints").glob("*.ckpt")}
    assert names == ({"canonical", "deformation"} if protocol == "two_stage" else {protocol})
    export = ("stage=export", "hydra.run.dir=run", "trainer=cpu", "export.format=ply")
    if method in ("tineuvox", "kplanes") and scene == "tiny_data":
        done = devrf(*export, "export.threshold=1e-5", "export.side=12", "export.times=[0,1]")
        assert (done.status, done.err) == (0, "")
        meshes = [trimesh.load(path) for path in sorted((run / "export/ply").glob("*.ply"))]
        assert len(meshes) == 2 and all(len(mesh.faces) for mesh in meshes)
    if method != "dnerf":
        return
    # Whatever was learned is not learned again.
    assert "learned already" in devrf(*asked).out
    refused = devrf("stage=export", "hydra.run.dir=run", "trainer=cpu")
    assert refused.status == 2
    assert "has a mesh of its own at each time, and gltf moves one" in refused.err
    done = devrf(*export, "export.content=points", "export.points=20")
    assert (done.status, done.err) == (0, "")
    assert len(list((run / "export" / "points").glob("frame_*.ply"))) == 3


@pytest.mark.parametrize(
    ("method", "asked", "said"),
    [
        ("dnerf", ["stage=canonical"], "stage: expected one of pipeline, joint,"),
        ("dnerf", ["+ray_stage.loss.elastic=1"], "ray_stage.loss: unknown term 'elastic'"),
        ("hypernerf", [f"{SETTINGS}.slicing=line"], "slicing: expected"),
        ("nsff", ["protocol=two_stage"], "method=nsff does not learn by protocol=two_stage"),
        ("neural_volumes", ["data.train_views=1"], "encoder_views: expected at most 1"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(devrf, tiny_data, method, asked, said):
    small = (f"method={method}", "experiment=peer_small", *SMALL[method], *SHORT)
    done = devrf(*small, *tiny_data, "protocol=joint", *asked)
    assert done.status == 2 and said in done.err and done.err.count("\n") == 1, done.err


def test_a_method_with_a_stage_of_its_own_needs_nothing_elsewhere(
    devrf, tmp_path, tiny_data, monkeypatch
):
    section = PAGE.read_text().split("{ #own-stages }")[1].split("\n## ")[0]
    texts = re.findall(r"```(?:python|yaml)\n(.*?)```", section, re.DOTALL)
    names = ("grey/model.py", "conf/method/grey.yaml", "conf/protocol/grey.yaml")
    for name, text in zip(names, texts, strict=True):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    asked = (
        "--config-dir",
        str(tmp_path / "conf"),
        "method=grey",
        "protocol=grey",
        "video.frames=2",
    )
    asked += ("video.height=32", "hydra.run.dir=run")
    done = devrf(*asked, *tiny_data, "schedule.seconds=1")
    assert done.status == 0 and "needs about" in done.out, done.err
    scores = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert scores["dynamic"]["psnr"] > 8 and scores["method"] == "grey"
    assert devrf(*asked, *tiny_data, "stage=still", "still.height=20").status == 0
    done = devrf(*asked, *tiny_data, "rehearse=true", "hydra.run.dir=rehearsed")
    assert "rehearsed: every stage learns" in done.out or "rehearse: " in done.err


def test_a_networks_first_weights_follow_the_seed(devrf, tiny_data, monkeypatch):
    first: list[torch.Tensor] = []
    usual = RayStage.on_train_start

    def noted(stage: RayStage) -> None:
        weights = [values.detach().flatten() for values in stage.scene_model.parameters()]
        first.append(torch.cat(weights))
        usual(stage)

    monkeypatch.setattr(RayStage, "on_train_start", noted)
    small = ("method=dnerf", "experiment=peer_small", *SMALL["dnerf"], *SHORT, *tiny_data)
    for number, seed in enumerate((0, 0, 1)):
        torch.rand(number)  # drawn before the command
        words = ("protocol=joint", "stage=joint", f"seed={seed}", f"hydra.run.dir=run{number}")
        assert devrf(*small, *words).status == 0
    assert torch.equal(first[0], first[1]) and not torch.equal(first[0], first[2])


def test_the_method_of_the_documentation_is_learned_and_loaded(
    devrf, tmp_path, tiny_data, monkeypatch
):
    section = PAGE.read_text().split("{ #protocol }")[0]
    model, config = re.findall(r"```(?:python|yaml)\n(.*?)```", section, re.DOTALL)
    for name, text in (("wobble/model.py", model), ("conf/method/wobble.yaml", config)):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(text)
    places = [*methods.__path__, str(tmp_path)]
    monkeypatch.setattr(methods, "__path__", places)
    asked = ("--config-dir", str(tmp_path / "conf"), "method=wobble", "protocol=two_stage", *SHORT)
    done = devrf(*asked, *tiny_data, "ray_stage.model.width=8")
    assert done.status == 0, done.err
    learned = json.loads((tmp_path / "run" / "metrics.json").read_text())
    (tmp_path / "run" / "metrics.json").unlink()
    done = devrf(*asked, *tiny_data, "ray_stage.model.width=8", "stage=evaluate")
    assert done.status == 0, done.err
    scored = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert scored["dynamic"]["psnr"] == learned["dynamic"]["psnr"] > 3
