"""``stage=benchmark``: how fast a scene is learned and shown, measured for moments."""

from __future__ import annotations

import json
import shutil

import pytest

BRIEF = ("stage=benchmark", "benchmark.repeats=1", "benchmark.views=2")


def test_a_learned_scene_is_measured_with_what_it_has_learned(devrf, tmp_path, tiny, trained):
    shutil.copytree(trained[0] / "checkpoints", tmp_path / "run" / "checkpoints")
    before = (tmp_path / "run" / "checkpoints" / "deformation.ckpt").read_bytes()
    outcome = devrf(*tiny, *BRIEF, "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    assert "milliseconds an iteration" in outcome.out and "held-out views" in outcome.out
    found = json.loads((tmp_path / "run" / "benchmark.json").read_text())
    assert found["scene"] == "robot" and "deformation.ckpt" in found["state"]
    assert [(row["stage"], row["phase"]) for row in found["training"]] == [
        ("canonical", "fine"),
        ("canonical", "fine"),
        ("deformation", "level 0"),
        ("deformation", "level 1"),
    ]
    voxels = [row["resolution"][0] for row in found["training"]]
    assert voxels[0] < voxels[1] and voxels[2] < voxels[3]
    for row in found["training"]:
        assert row["kernels"] == "torch" and row["ms"]["median"] > 0
        assert row["parts_ms"]["backward"]["median"] > 0 and row["samples"]["heavy"] > 0
        assert 0 < row["floor"]["share"] < 1
    (pictures,) = found["rendering"]
    assert (pictures["width"], pictures["height"], pictures["views"]) == (24, 20, 2)
    assert found["device"]["copy_gb_per_s"] > 0 and found["run"]["seed"] == 0
    assert found["notes"] == ["triton was not measured: it needs a CUDA device"]
    assert found["notes"][0] in outcome.out
    # Nothing was learned on the way.
    assert (tmp_path / "run" / "checkpoints" / "deformation.ckpt").read_bytes() == before


def test_without_a_checkpoint_some_is_learned_first(devrf, tmp_path, tiny):
    outcome = devrf(
        *tiny,
        *BRIEF,
        "hydra.run.dir=run",
        "schedule.canonical.search_iterations=120",
        "schedule.canonical.iterations=40",
        "benchmark.training=0.5",
    )
    assert (outcome.status, outcome.err) == (0, "")
    found = json.loads((tmp_path / "run" / "benchmark.json").read_text())
    assert found["state"] == "canonical and deformation learned in 50 % of the schedule"
    assert [row["phase"] for row in found["training"]] == [
        "search",
        "fine",
        "fine",
        "level 0",
        "level 1",
    ]
    assert "the search is measured at its beginning" in found["notes"][1]
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["benchmark.repeats=0"], "benchmark.repeats: expected at least 1, not 0"),
        (["benchmark.training=2"], "benchmark.training: expected more than 0 and at most 1"),
        (["ckpt=no.ckpt"], "no.ckpt: no such checkpoint"),
        (["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"], "leave out trainer=ddp"),
    ],
)
def test_what_cannot_be_measured_is_a_mistake(devrf, tmp_path, tiny, arguments, expected):
    outcome = devrf(*tiny, "stage=benchmark", *arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1 and expected in outcome.err
    assert not list(tmp_path.iterdir())
