"""Scenes written for other programs read back with the same cameras, times, pictures and split."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from devrf.evaluation.predictions import read_predictions
from devrf.evaluation.scoring import score_pictures
from devrf.evaluation.suite import MetricSuite
from devrf.scenes.exchange import write_for_others
from devrf.scenes.export import write_image
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.dycheck import DycheckReader
from devrf.scenes.formats.nerfies import NerfiesReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.procedural import ProceduralForwardScene
from devrf.scenes.scene import Scene, Views
from devrf.scenes.sparse_model import read_model

READERS = {
    "dnerf": (BlenderReader,),
    "nerfies": (NerfiesReader, DycheckReader),
    "colmap": (NerfstudioReader,),
}


@pytest.fixture(scope="module")
def film() -> Scene:
    """A hand-held film with masks of held-out pixels, in seven frames."""
    return ProceduralForwardScene(camera="handheld", frames=7, width=24, height=18, supersample=1)()


def same(there: Views, here: Views) -> None:
    assert len(there) == len(here)
    torch.testing.assert_close(there.times, here.times, atol=1e-6, rtol=0)
    for name in ("camera_to_world", "focal", "center"):
        ours, read = getattr(here.cameras, name), getattr(there.cameras, name)
        torch.testing.assert_close(read, ours, atol=1e-6, rtol=1e-6)
    for k in range(len(here)):
        assert torch.equal(there.single(k).pixels, here.single(k).pixels)


@pytest.mark.parametrize("layout", READERS)
def test_what_is_written_reads_back(layout, tiny_scene, two_sizes, film, tmp_path):
    far = replace(tiny_scene, offset=(500_000.0, 5_600_000.0, 200.0))
    at_rest = replace(tiny_scene, dynamic=tiny_scene.static)
    for number, scene in enumerate((tiny_scene, two_sizes, far, film, at_rest)):
        root = tmp_path / str(number)
        write_for_others(scene, root, layout)
        for reader in READERS[layout]:
            again = reader(root, downscale=1).read()
            if scene is at_rest:
                same(again.static.train, scene.static.train)
                assert not again.moves
            elif reader is NerfstudioReader and scene is not film:
                # The images of time 0 are its static set, those of fixed cameras its dynamic one.
                same(again.dynamic.train, scene.dynamic.train)
            else:
                train = again.dynamic.train
                count = len(train) - len(scene.dynamic.train)
                same(train[torch.arange(count, len(train))], scene.dynamic.train)
                # One moving camera has no static set; else it comes first.
                assert count == (0 if scene is film else len(scene.static.train))
                if count:
                    static = replace(scene.static.train, times=torch.zeros(count))
                    same(train[torch.arange(count)], static)
            same(again.dynamic.test, scene.dynamic.test)
            masks = again.dynamic.test.valid_mask
            if scene is film and reader in (DycheckReader, NerfstudioReader):
                assert masks is not None and torch.equal(masks, scene.dynamic.test.valid_mask)


def test_colmaps_model_has_the_cameras(tiny_toy, tmp_path):
    write_for_others(tiny_toy, tmp_path / "toy", "colmap")
    model = read_model(tmp_path / "toy" / "sparse" / "0")
    names = [image.name for image in model.images]
    test = tiny_toy.dynamic.test
    assert names[: len(test)] == [f"test_{k:05d}.png" for k in range(len(test))]
    assert {path.name for path in (tmp_path / "toy" / "images").iterdir()} == {*names}
    poses = model.poses[: len(test)].float()
    torch.testing.assert_close(poses, test.cameras.camera_to_world, atol=1e-6, rtol=0)
    for lens in model.intrinsics[: len(test)]:
        assert lens.focal == tuple(test.cameras.focal[0].tolist())
        assert lens.center == tuple(test.cameras.center[0].tolist())
    assert len(model.points) == 0 and len(model.cameras) == 1


def test_what_a_layout_has_no_place_for_is_said(two_sizes, film, tmp_path, caplog):
    write_for_others(two_sizes, tmp_path / "sizes", "dnerf")
    assert "reads camera_angle_x" in caplog.text
    caplog.clear()
    masked = replace(film.dynamic.train, valid_mask=torch.rand(7, 18, 24) > 0.5)
    write_for_others(
        replace(film, dynamic=replace(film.dynamic, train=masked)), tmp_path / "film", "nerfies"
    )
    assert caplog.text.count("no place for masks") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"sizes", "film"}


def test_whole_times_count_from_zero(film, tmp_path: Path):
    write_for_others(film, tmp_path / "film", "nerfies")
    text = (tmp_path / "film" / "splits" / "train.json").read_text()
    assert '"time_ids": [\n    0,\n    1,\n    2,' in text


def test_pictures_under_the_names_of_held_out_images_are_found(tiny_scene, tmp_path):
    views = tiny_scene.dynamic.test
    write_for_others(tiny_scene, tmp_path / "robot", "nerfies")
    for k in range(len(views)):
        darker = (views.pixels[k].float() * torch.tensor([0.9, 0.9, 0.9, 1.0])).to(torch.uint8)
        write_image(tmp_path / "rendered" / f"test_{k:05d}.png", darker)
    found = read_predictions(tmp_path / "rendered", {"dynamic": views}, "white")["dynamic"]
    scored = score_pictures("dynamic", found, views, "white", MetricSuite())
    assert all(30 < view.psnr < 50 for view in scored)
