"""Listed images that are not there: counted in one line, or left out with one warning."""

from __future__ import annotations

import logging

import pytest
import torch

from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.nerfies import NerfiesReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader


def warnings_in(caplog) -> list[str]:
    return [r.getMessage() for r in caplog.records if "absent" in r.getMessage()]


def test_they_are_counted(scene_folder, refusal):
    for k in (2, 4, 5):
        (scene_folder.static / f"train/r_{k:03d}.png").unlink()
    message = refusal(BlenderReader, scene_folder.root)
    assert message.startswith(f"{scene_folder.static}/train/r_002: no such image")
    assert "3 of the 6 images in transforms_train.json are absent" in message
    assert "data.missing=skip" in message


def test_they_are_left_out(scene_folder, caplog):
    whole = BlenderReader(scene_folder.root).read().static.train
    for k in (2, 4):
        (scene_folder.static / f"train/r_{k:03d}.png").unlink()
    scene = BlenderReader(scene_folder.root, missing="skip").read()
    kept = torch.tensor([0, 1, 3, 5])
    assert scene.static.train.names == whole[kept].names
    assert torch.equal(scene.static.train.pixels, whole.pixels[kept])
    poses = scene.static.train.cameras.camera_to_world
    assert torch.equal(poses, whole.cameras.camera_to_world[kept])
    (line,) = warnings_in(caplog)
    assert "2 of the 6 images are absent and left out, static/train/r_002 the first" in line


def test_all_of_them_cannot_be_left_out(scene_folder, refusal):
    for path in (scene_folder.static / "train").iterdir():
        path.unlink()
    message = refusal(BlenderReader, scene_folder.root, missing="skip")
    assert "6 of the 6 images in transforms_train.json are absent: add them" in message
    assert "data.missing" not in message


def test_flow_files_are_dropped_where_their_numbers_are_uncertain(scene_folder, caplog):
    (scene_folder.dynamic / "train/r_002.png").unlink()
    with caplog.at_level(logging.INFO):
        scene = BlenderReader(scene_folder.root, missing="skip").read()
    assert len(scene.dynamic.train) == 5 and scene.dynamic.train.flow is None
    assert "flow files dropped: they are numbered by images" in caplog.text


def test_in_a_file_that_lists_what_is_held_out(tmp_path, balls, caplog):
    root = tmp_path / "scene"
    balls.write(root, [k / 8 for k in range(9)])
    names = [f"images/r_{k:03d}.png" for k in range(9)]
    balls.edit(root, lambda content: content.update(test_filenames=[names[3], names[7]]))
    for k in (1, 3):
        (root / names[k]).unlink()
    scene = NerfstudioReader(root, missing="skip").read()
    assert scene.dynamic.test.names == (names[7],)
    assert scene.dynamic.train.names == tuple(names[k] for k in (0, 2, 4, 5, 6, 8))
    assert len(warnings_in(caplog)) == 1


@pytest.mark.parametrize("reader", [BlenderReader, NerfstudioReader, NerfiesReader])
def test_the_choice_is_checked(reader, refusal):
    assert refusal(reader, "scene", missing="maybe").startswith("data.missing: ")
