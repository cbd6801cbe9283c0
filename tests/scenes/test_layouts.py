"""Every layout read as ``data=`` reads it: one scene through all of them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from devrf.data.recorded import READERS


@pytest.mark.parametrize("choice", READERS)
def test_each_layout_gives_a_scene(choice, write_layout, tmp_path):
    write_layout(choice, tmp_path / "scene")
    scene = READERS[choice](tmp_path / "scene").read()
    assert scene.name == "scene" and scene.moves is (choice != "colmap")
    assert scene.kind == ("forward" if choice in ("forward", "neural_3d_video") else "inward")


def test_the_layouts_say_the_same(tiny_scene, write_layout, tmp_path):
    """The same rays, times and pixels."""
    given = tiny_scene.dynamic.train
    for choice in ("inward", "nerfstudio", "nerfies", "dycheck"):
        write_layout(choice, tmp_path / choice)
        train = READERS[choice](tmp_path / choice).read().dynamic.train
        moving = ["static" not in Path(name).stem for name in train.names]
        views = train[torch.tensor(moving).nonzero()[:, 0]]
        torch.testing.assert_close(views.times, given.times)
        assert torch.equal(views.pixels, given.pixels)
        for image in range(len(given)):
            expected, found = given.cameras.image_rays(image), views.cameras.image_rays(image)
            torch.testing.assert_close(found.origins, expected.origins, atol=1e-5, rtol=0)
            torch.testing.assert_close(found.directions, expected.directions, atol=1e-5, rtol=0)
