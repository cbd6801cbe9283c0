"""Every layout read as ``data=`` reads it: one scene through all of them."""

from __future__ import annotations

from pathlib import Path

import torch

from devrf.data.recorded import READERS


def test_the_layouts_say_the_same(tiny_scene, write_layout, tmp_path):
    """The same rays, times and pixels."""
    given = tiny_scene.dynamic.train
    for choice in ("inward", "nerfstudio", "nerfies", "dycheck", "panoptic", "easyvolcap"):
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
