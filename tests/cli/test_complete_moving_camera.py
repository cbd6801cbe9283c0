"""A capture by a camera that moves, learned, scored and reported by its folder alone."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import pytest

from devrf.cli import preparation
from devrf.scenes.export import export
from devrf.scenes.procedural import ProceduralForwardScene, ProceduralScene
from devrf.scenes.view_folders import dynamic_folders
from layouts import write_scene


@pytest.fixture
def mill(tmp_path, monkeypatch) -> None:
    """A folder ``mill`` in DyCheck's layout: one camera, elsewhere at each of three times."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    sizes = {"width": 24, "height": 20, "static_views": 16, "static_test_views": 3}
    scene = ProceduralScene(shape="robot", train_views=2, frames=3, supersample=1, **sizes)()
    # The moving camera stands where one fixed view does, then where the next one does.
    train = scene.dynamic.train
    path = train[(train.frames % 2 == train.view).nonzero()[:, 0]]
    write_scene(
        "dycheck", replace(scene, dynamic=replace(scene.dynamic, train=path)), tmp_path / "mill"
    )


def test_a_capture_needs_no_flag_beside_its_folder(devrf, mill, tmp_path) -> None:
    small = (
        "ray_stage.model.settings.side=12",
        "ray_stage.schedule.iterations=4",
        "ray_stage.schedule.rays=64",
        "video.frames=1",
        "video.height=24",
    )
    run = devrf("data.root=mill", "schedule.seconds=null", *small, "evaluation.metrics=[]")
    assert (run.status, run.err) == (0, "")
    why = (
        "one moving camera, where method=devrf needs the scene at rest, too; the layout of DyCheck"
    )
    assert f"mill: {why} (data=dycheck experiment=phone)" in run.out
    (folder,) = (tmp_path / "outputs/mill").iterdir()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["method"] == "tineuvox" and metrics["protocol"] == "dynamic"


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ((), "where method=devrf needs the scene at rest, too (experiment=phone)"),
        (("method=dnerf", "profile=dnerf_small"), "the scene at rest, too (protocol=dynamic)"),
        (("method=devrf",), "experiment=phone learns more of it than method=devrf"),
    ],
)
def test_an_embedded_film_by_hand_is_learned_as_others_are(
    devrf, tiny_facing, monkeypatch, typed, said
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    outcome = devrf(*tiny_facing, "data.camera=handheld", *typed, "stage=inspect")
    assert (outcome.status, outcome.err) == (0, "")
    assert "data.camera=handheld: one" in outcome.out and said in outcome.out


def test_a_video_in_llffs_layout_is_learned_as_one(devrf, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    small = {"static_views": 8, "frames": 3, "width": 24, "height": 18, "supersample": 1}
    export(ProceduralForwardScene(**small)(), tmp_path / "video")
    for folder in dynamic_folders(tmp_path / "video"):
        shutil.rmtree(folder)
    still = devrf("data=forward", "data.root=video", "data.downscale=4", "stage=inspect")
    assert still.status == 0 and "experiment=" not in still.out
    words = ("data=forward", "data.root=video", "data.monocular=true", "data.downscale=4")
    film = devrf(*words, "stage=inspect")
    assert (film.status, film.err) == (0, "")
    assert "scene at rest, too; its cameras (experiment=phone)" in film.out


def test_frames_in_the_order_of_their_names_are_a_film(devrf, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    small = {"frames": 9, "width": 24, "height": 18, "supersample": 1}
    export(ProceduralForwardScene(camera="handheld", **small)(), tmp_path / "posed")
    file = tmp_path / "posed" / "transforms.json"
    content = json.loads(file.read_text())
    frames = [frame for frame in content["frames"] if frame["file_path"].startswith("images")]
    for frame in frames:
        del frame["time"]
    kept = {k: v for k, v in content.items() if k[:5] not in ("scene", "train", "test_")}
    file.write_text(json.dumps(kept | {"frames": frames}))
    outcome = devrf("data.root=posed", "data.times=order", "stage=inspect")
    assert (outcome.status, outcome.err) == (0, "")
    assert "(data=nerfstudio experiment=phone)" in outcome.out
    (tmp_path / "two").mkdir()
    file.parent.rename(tmp_path / "two" / "static")  # and a film: DeVRF has what it needs
    shutil.copytree(tmp_path / "two" / "static", tmp_path / "two" / "dynamic")
    outcome = devrf("data.root=two", "data.times=order", "stage=inspect")
    assert outcome.status == 0 and "(data=nerfstudio)" in outcome.out


def test_devrf_learns_such_a_capture_where_it_is_chosen(devrf, short, mill, tmp_path) -> None:
    quick = (*short, "schedule.canonical.visual_hull_init=false", "video.frames=1")
    run = devrf("data.root=mill", "method=devrf", *quick, "evaluation.metrics=[]")
    assert (run.status, run.err) == (0, "")
    assert "(data=dycheck)" in run.out
    metrics = json.loads((tmp_path / "outputs/mill/quickstart/metrics.json").read_text())
    assert metrics["scene"] == "mill" and metrics["run"]["choices"]["data"] == "dycheck"
    assert metrics["run"]["train_views"] == 1  # one camera, however many images it took
    reported = devrf("stage=report")
    assert (reported.status, reported.err) == (0, "")
    assert "mill" in reported.out and f"{metrics['dynamic']['psnr']:.2f}" in reported.out


@pytest.mark.parametrize(
    ("layout", "said"),
    [
        ("nerfstudio", "learning takes about 30 s on this machine"),
        ("dycheck", "learning takes about 10 min on this machine"),
    ],
)
def test_a_capture_ends_with_the_command_that_learns_it(
    devrf, mill, tmp_path, monkeypatch, layout, said
) -> None:
    sizes = {"width": 24, "height": 20, "static_views": 8, "frames": 3, "supersample": 1}
    write_scene("nerfstudio", ProceduralScene(train_views=2, **sizes)(), tmp_path / "robot")
    folder = tmp_path / ("robot" if layout == "nerfstudio" else "mill")
    # Structure from motion, and ten seconds of learning, are tested where they are written.
    monkeypatch.setattr(preparation, "scene_from_footage", lambda settings: folder)
    monkeypatch.setattr(preparation, "seconds_to_learn", lambda *arguments: 30.0)
    done = devrf("stage=capture", "capture.views=[film.mp4]", "capture.into=there")
    assert (done.status, done.err) == (0, "")
    assert f"(data={layout}" in done.out and said in done.out
    assert done.out.rstrip().endswith(f"next:\n  python -m devrf data.root={folder}")
