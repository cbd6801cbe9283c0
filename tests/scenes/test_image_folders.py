"""Listed images that are not there: counted in one line, or left out with one warning."""

from __future__ import annotations

import logging
import sys
from functools import partial

import pytest
import torch

from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.image_folders import listed_images, whole_factor


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


def _photograph(height: int, factor: int) -> tuple[int, int]:
    return height * 4 // (3 * factor), height // factor


@pytest.mark.parametrize(
    ("downscale", "height", "factor"),
    [
        ("up_to_4", 800, 4),
        ("up_to_4", 255, 3),
        ("up_to_4", 24, 1),
        (4, 24, 4),
        ("cpu", 3024, 8),  # a phone's photograph: 504 x 378
        ("gpu", 3024, 4),  # 1008 x 756
        ("cpu", 480, 1),
    ],
)
def test_the_factor(downscale: int | str, height: int, factor: int) -> None:
    assert whole_factor(downscale, partial(_photograph, height)) == factor


@pytest.mark.skipif(torch.cuda.is_available(), reason="a machine without a GPU")
def test_auto_says_for_which_device_it_chose(caplog):
    with caplog.at_level(logging.INFO):
        assert whole_factor("auto", partial(_photograph, 3024)) == 8
    assert "made smaller by 8 (chosen for a CPU;" in caplog.text


def test_the_folder_that_is_there_is_taken(llff_folder, caplog):
    """With images_4 alone nothing larger can be read; beside images these are."""
    assert LlffReader(llff_folder.root).read().static.train.width == 24
    for folder in ("static", *(f"dynamic_3views/view{k}" for k in (1, 2, 3))):
        llff_folder.images(
            llff_folder.root / folder / "images", 9 if folder == "static" else 3, times=4
        )
    with caplog.at_level(logging.INFO):
        scene = LlffReader(llff_folder.root, downscale="up_to_4").read()
    # 96 x 64 pixels: made smaller at all they would have fewer than 64.
    assert (scene.static.train.width, scene.dynamic.train.width) == (96, 96)
    assert "images of 96x64 px, made smaller by 1 (data.downscale=up_to_4;" in caplog.text


# Names that are not UTF-8

LATIN = "caf\udce9"  # b"caf\xe9" on the disk
linux = pytest.mark.skipif(sys.platform != "linux", reason="here all names are UTF-8")


@linux
def test_a_name_that_is_not_utf8_is_refused_where_it_is_used(
    llff_folder, scene_folder, refusal, tmp_path
):
    said = r"caf\xe9{}: its name is not UTF-8 text; rename it"
    images = llff_folder.static / "images_4"
    (images / f"{LATIN}.txt").touch()
    (llff_folder.root / LATIN).mkdir()
    read = partial(LlffReader, llff_folder.root, downscale=4)
    assert len(read().read().static.train) > 0  # what is not used may have any name
    listed_images(images)[3].rename(images / f"{LATIN}.png")
    assert refusal(LlffReader, llff_folder.root, downscale=4).endswith(said.format(".png"))
    named = scene_folder.root / f"dynamic_{LATIN}views"
    scene_folder.dynamic.rename(named)
    assert refusal(BlenderReader, scene_folder.root).endswith(said.format("views"))
    (tmp_path / "link").symlink_to(scene_folder.root.rename(tmp_path / LATIN))
    assert refusal(BlenderReader, tmp_path / "link").endswith(said.format(""))


def test_a_scene_of_a_name_that_cannot_be_shown_is_refused(scene_folder, refusal):
    shown = scene_folder.root.rename(scene_folder.root.with_name("at 1.00\u202fPM"))
    assert BlenderReader(shown).read().name == "at 1.00\u202fPM"
    root = shown.rename(shown.with_name("a\tb"))
    assert "its name holds control characters; rename it" in refusal(BlenderReader, root)
