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
def mill(tmp_path) -> None:
    """A folder ``mill`` in DyCheck's layout: one camera, elsewhere at each of three times."""
    sizes = {"width": 24, "height": 20, "static_views": 16, "static_test_views": 3}
    scene = ProceduralScene(shape="robot", train_views=2, frames=3, supersample=1, **sizes)()
    # The moving camera stands where one fixed view does, then where the next one does.
    train = scene.dynamic.train
    path = train[(train.frames % 2 == train.view).nonzero()[:, 0]]
    write_scene(
        "dycheck", replace(scene, dynamic=replace(scene.dynamic, train=path)), tmp_path / "mill"
    )


def test_a_capture_by_one_camera_needs_one_word_beside_its_folder(devrf, mill, tmp_path) -> None:
    small = (
        "ray_stage.model.settings.start_points=60",
        "ray_stage.schedule.iterations=4",
        "video.frames=1",
        "video.height=24",
    )
    refused = devrf("data.root=mill")
    assert refused.status == 2 and refused.err.count("\n") == 1
    assert "which method=devrf needs; give experiment=phone" in refused.err
    assert not (tmp_path / "outputs").exists()
    phone = ("data.root=mill", "experiment=phone", "schedule.seconds=null")
    run = devrf(*phone, *small, "evaluation.metrics=[]")
    assert (run.status, run.err) == (0, "")
    assert "mill: the layout of DyCheck (data=dycheck)" in run.out
    (folder,) = (tmp_path / "outputs/mill").iterdir()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["method"] == "gaussians" and metrics["protocol"] == "dynamic"


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ((), "which method=devrf needs; give experiment=phone"),
        (("method=dnerf", "profile=dnerf_small"), "one camera (protocol=dynamic)"),
        (("method=devrf",), "which method=devrf needs; experiment=phone learns more of it"),
    ],
)
def test_an_embedded_film_by_hand_is_learned_as_others_are(devrf, tiny_facing, typed, said) -> None:
    step = ("stage=prepare", "prepare.into=film")
    outcome = devrf(*tiny_facing, "data.camera=handheld", *typed, *step)
    assert (outcome.status, outcome.err) == (0, "")
    assert "data.camera=handheld: one" in outcome.out and said in outcome.out


def test_a_video_in_llffs_layout_is_learned_as_one(devrf, tmp_path) -> None:
    small = {"static_views": 8, "frames": 3, "width": 24, "height": 18, "supersample": 1}
    export(ProceduralForwardScene(**small)(), tmp_path / "video")
    for folder in dynamic_folders(tmp_path / "video"):
        shutil.rmtree(folder)
    still = devrf("data=forward", "data.root=video", "data.downscale=4", "stage=inspect")
    assert still.status == 0 and "experiment=" not in still.out
    words = ("data=forward", "data.root=video", "data.monocular=true", "data.downscale=4")
    film = devrf(*words, "stage=inspect")
    assert (film.status, film.err) == (0, "")
    assert "video: one moving camera" in film.out


def test_frames_in_the_order_of_their_names_are_a_film(devrf, tmp_path) -> None:
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
    assert "posed: one moving camera" in outcome.out
    (tmp_path / "two").mkdir()
    file.parent.rename(tmp_path / "two" / "static")  # and a film: DeVRF has what it needs
    shutil.copytree(tmp_path / "two" / "static", tmp_path / "two" / "dynamic")
    outcome = devrf("data.root=two", "data.times=order", "stage=inspect")
    assert outcome.status == 0 and "one moving camera" not in outcome.out


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


@pytest.mark.parametrize("layout", ["nerfstudio", "dycheck"])
def test_a_capture_ends_with_the_command_that_learns_it(
    devrf, mill, tmp_path, monkeypatch, layout
) -> None:
    sizes = {"width": 24, "height": 20, "static_views": 8, "frames": 3, "supersample": 1}
    write_scene("nerfstudio", ProceduralScene(train_views=2, **sizes)(), tmp_path / "robot")
    folder = tmp_path / ("robot" if layout == "nerfstudio" else "mill")
    # Structure from motion is tested where it is written.
    monkeypatch.setattr(preparation, "scene_from_footage", lambda settings: folder)
    views, typed = (
        ("[a.mp4,b.mp4]", "") if layout == "nerfstudio" else ("[a.mp4]", " experiment=phone")
    )
    done = devrf("stage=capture", f"capture.views={views}", "capture.into=there", "trainer=cpu")
    assert (done.status, done.err) == (0, "")
    assert f"(data={layout}" in done.out
    assert done.out.rstrip().endswith(f"next:\n  python -m devrf data.root={folder}{typed}")
