"""``up_to_<N>``: no further than to 64 pixels of the shorter side; a number is obeyed."""

from __future__ import annotations

import logging

import pytest

from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.image_folders import whole_factor


@pytest.mark.parametrize(
    ("downscale", "side", "factor"),
    [
        ("up_to_4", 800, 4),
        ("up_to_4", 256, 4),
        ("up_to_4", 255, 3),
        ("up_to_4", 128, 2),
        ("up_to_4", 100, 1),
        ("up_to_4", 24, 1),
        (4, 24, 4),
        (1, 800, 1),
    ],
)
def test_the_factor(downscale: int | str, side: int, factor: int) -> None:
    assert whole_factor(downscale, lambda by: side // by) == factor


def test_the_folder_that_is_there_is_taken(llff_folder, caplog):
    """With images_4 alone nothing larger can be read; beside images these are."""
    assert LlffReader(llff_folder.root).read().static.train.width == 24
    for folder in ("static", *(f"dynamic_3views/view{k}" for k in (1, 2, 3))):
        llff_folder.images(
            llff_folder.root / folder / "images", 9 if folder == "static" else 3, times=4
        )
    with caplog.at_level(logging.INFO):
        scene = LlffReader(llff_folder.root).read()
    # 96 x 64 pixels: made smaller at all they would have fewer than 64.
    assert (scene.static.train.width, scene.dynamic.train.width) == (96, 96)
    assert (
        "images keep their size, although data.downscale=up_to_4: their shorter side has 64"
        in caplog.text
    )


def test_an_image_that_is_too_small_stays_as_it_is(scene_folder, refusal):
    assert BlenderReader(scene_folder.root, downscale="up_to_4").read().static.train.width == 32
    assert "8x6 px" in refusal(BlenderReader, scene_folder.root, downscale=4)
    message = refusal(BlenderReader, scene_folder.root, downscale="4x")
    assert message.startswith("data.downscale: ") and "up_to_<number>" in message
