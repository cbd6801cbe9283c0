"""``rehearse=true``: settings that are made for a GPU, learned in seconds; and what it leaves."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from devrf.apps.rehearsal import Learned, RehearsedStage, for_rehearsal, shortfalls
from devrf.data.datamodule import SceneDataModule
from devrf.methods import ray_plan
from devrf.methods.devrf import plans

SCENE = ("data.width=32", "data.height=32", "data.static_views=16", "data.frames=4")
SCENE += ("data.supersample=1", "~callbacks.training_curve", "~callbacks.previews")
FORWARD = ("experiment=paper", "rehearse=true", *SCENE)
PAPER = (*FORWARD, "data.static_test_views=2")
PEER = ("experiment=peer_paper", "protocol=joint", "rehearse=true", *SCENE)
PEER += ("data.width=24", "data.height=24", "data.static_test_views=1")
QUICK = ("hydra.run.dir=run", "evaluation.metrics=[]", "still.height=16")


@pytest.fixture(autouse=True, scope="module")
def smaller() -> Iterator[None]:
    """Half of a rehearsal's iterations, rays and width, or less: these scenes are small."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plans, "REHEARSED_ITERATIONS", 300)
        patch.setattr(plans, "REHEARSED_WIDTH", 16)
        patch.setattr(ray_plan, "REHEARSED_RAYS", 128)
        yield


@pytest.fixture(scope="module")
def paper(
    smaller: None, devrf_in: Any, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Any]:
    """The folder of a rehearsal of the paper's settings, and what the command said."""
    folder = tmp_path_factory.mktemp("paper")
    return folder, devrf_in(folder, *PAPER)


def record(folder: Path) -> dict[str, Any]:
    """What a rehearsal has written."""
    content: dict[str, Any] = json.loads((folder / "rehearsal.json").read_text())
    return content


def test_the_papers_settings_learn_an_inward_facing_scene(paper):
    folder, done = paper
    assert done.status == 0, done.err
    found = record(folder / "outputs/robot/paper-rehearsal")
    rehearsal = found["rehearsal"]
    static, dynamic = (rehearsal["learned"][name] for name in ("static", "dynamic"))
    assert static["psnr"] > static["blank"] + 4
    assert dynamic["psnr"] > dynamic["rest_pose"] + 0.4
    stages = rehearsal["stages"]
    assert (stages["canonical"]["whole"], stages["deformation"]["whole"]) == (25_000, 2000)
    for stage in stages.values():
        assert stage["iterations"] < 400 and stage["events"] == stage["planned"]
    assert stages["canonical"]["planned"]["geometry searched"] == 1
    assert stages["deformation"]["planned"] == {
        "levels begun": 5, "grids grown": 4, "visits of frames": 15,
    }  # fmt: skip
    assert rehearsal["shortfalls"] == [] and found["static"]["psnr"] > 15
    # What the run itself needs is of its own grids and images.
    for words in ("300 of 25 000", "96 of 2 000", "geometry searched: 1 of 1", "GB"):
        assert words in done.out


def test_the_papers_settings_learn_a_forward_facing_scene(devrf, tmp_path, monkeypatch):
    monkeypatch.setattr(plans, "REHEARSED_RAYS", 96)
    done = devrf("data=procedural_forward", *FORWARD, *QUICK, "stage=canonical")
    assert done.status == 0, done.err
    found = record(tmp_path / "run")["rehearsal"]
    assert found["learned"]["static"]["psnr"] > found["learned"]["static"]["blank"] + 6
    events = found["stages"]["canonical"]["events"]
    assert events["total variation of touched voxels alone"] == 1 and events["grids grown"] == 4


@pytest.mark.parametrize(
    ("words", "iterations", "event"),
    [
        (("method=kplanes", "profile=kplanes_video"), 110, "proposals learn rarely"),
        (("method=tineuvox", "profile=tineuvox_phone"), 110, "grids grown"),
    ],
)
def test_published_sizes_of_other_methods_learn(
    devrf, tmp_path, monkeypatch, words, iterations, event
):
    monkeypatch.setattr(ray_plan, "REHEARSED_ITERATIONS", iterations)
    done = devrf(*PEER, *words, *QUICK)
    assert done.status == 0, done.err
    stage = record(tmp_path / "run")["rehearsal"]["stages"]["joint"]
    assert stage["events"] == stage["planned"] and stage["events"][event] >= 1


def test_a_rehearsal_is_no_run(paper, devrf_in):
    folder, _ = paper
    place = folder / "outputs/robot/paper-rehearsal"
    assert not (place / "metrics.json").exists() and not (place / "logs").exists()
    assert len(list((place / "images").glob("still_*.png"))) == 2
    # Reports leave it out, and say so.
    done = devrf_in(folder, "stage=report", "report.runs=outputs")
    assert done.status == 2 and "1 of the folders hold a rehearsal, which is no run" in done.err
    # No run goes on in its folder.
    done = devrf_in(folder, f"hydra.run.dir={place}", "rehearse=false", "stage=canonical")
    assert done.status == 2 and "rehearse: " in done.err and "resume=false" in done.err
    # A command that names it looks at it, and leaves what was found when it learned.
    before = record(place)["rehearsal"]
    done = devrf_in(folder, f"hydra.run.dir={place}", "stage=evaluate")
    assert done.status == 0, done.err
    assert not (place / "metrics.json").exists() and record(place)["rehearsal"] == before


def test_a_rehearsal_leaves_a_run_alone(trained, devrf_in, tmp_path):
    folder, _ = trained
    before = (folder / "checkpoints/canonical.ckpt").stat().st_mtime_ns
    done = devrf_in(tmp_path, "rehearse=true", f"hydra.run.dir={folder}")
    assert done.status == 2
    assert "of a run; a rehearsal needs a folder of its own, hydra.run.dir=FOLDER" in done.err
    assert (folder / "checkpoints/canonical.ckpt").stat().st_mtime_ns == before
    assert (folder / "metrics.json").is_file()


def test_settings_by_which_nothing_is_found_end_with_status_2(devrf):
    # What counts as opaque at the end of a search empties it at its first renewal.
    done = devrf(*PAPER, "sampling.search_alpha_threshold=1e-3", "stage=canonical")
    assert done.status == 2 and "the geometry search found nothing opaque" in done.err


def test_a_stage_is_rehearsed_alone_and_one_that_does_not_learn_ends_with_status_2(
    paper, devrf, tmp_path
):
    shutil.copytree(paper[0] / "outputs/robot/paper-rehearsal", tmp_path / "run")
    before = (tmp_path / "run/checkpoints/canonical.ckpt").stat().st_mtime_ns
    still = ("schedule.visit.learning_rate=0", "loss.deformation.flow=0", "stage=deformation")
    done = devrf(*PAPER, *still, "hydra.run.dir=run")
    assert done.status == 2
    assert "rehearse: the deformation stage has learned no motion: " in done.err
    found = record(tmp_path / "run")["rehearsal"]
    assert found["shortfalls"] and list(found["stages"]) == ["deformation"]
    assert (tmp_path / "run/checkpoints/canonical.ckpt").stat().st_mtime_ns == before


def stage(capture: Any, events: dict[str, int] | None = None) -> RehearsedStage:
    return RehearsedStage(capture, 10, 100, {} if events is None else events, {"grids grown": 2})


def test_shortfalls_by_hand():
    grown = {"grids grown": 2}
    good = {"static": Learned(20, 14, None), "dynamic": Learned(18, 14, 17)}
    both = {"canonical": stage("static", grown), "deformation": stage("dynamic", grown)}
    assert shortfalls(both, good) == []
    blank = {**good, "static": Learned(14.9, 14, None)}
    (nothing,) = shortfalls(both, blank)
    assert nothing.startswith("the canonical stage has learned nothing of the static images")
    still = {**good, "dynamic": Learned(18, 14, 17.99)}
    (nothing,) = shortfalls(both, still)
    assert nothing.startswith("the deformation stage has learned no motion: 18.00 dB")
    # Of one stage of both captures each counts.
    neither = {"static": blank["static"], "dynamic": still["dynamic"]}
    assert len(shortfalls({"joint": stage("both", grown)}, neither)) == 2
    assert shortfalls({"canonical": stage("static", {"grids grown": 1})}, good) == [
        "grids grown 1 times of 2 in the canonical stage"
    ]
    assert shortfalls(
        {"joint": stage("static", grown)}, {"static": Learned(float("nan"), 14, None)}
    )


def test_a_rehearsals_scene_has_small_images_and_few_held_out(datamodule: SceneDataModule):
    scene = datamodule.scene
    small = for_rehearsal(scene)
    assert len(small.dynamic.train) == len(scene.dynamic.train)
    assert len(small.dynamic.test) == min(6, len(scene.dynamic.test))
    assert small.bounds == scene.bounds
    assert torch.equal(small.dynamic.test.times[[0, -1]], scene.dynamic.test.times[[0, -1]])
