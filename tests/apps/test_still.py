"""A still: which camera, which size, and that it is what the model shows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from lightning import Trainer

from devrf.apps.still import StillSettings, still
from devrf.apps.video import VideoSettings
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene


def test_the_camera_that_is_meant(tiny_scene: Scene) -> None:
    held_out = StillSettings().camera(Viewpoints.of(tiny_scene))
    assert torch.equal(held_out.positions, tiny_scene.dynamic.test.cameras.positions[:1])
    # The images are 24 x 18: pictures of them are rendered 400 pixels high.
    assert (held_out.width, held_out.height) == (533, 400)
    fifth = StillSettings(view=5, height=36).camera(Viewpoints.of(tiny_scene))
    assert torch.equal(fifth.positions, tiny_scene.static.train.cameras.positions[5:6])
    assert (fifth.width, fifth.height) == (48, 36)


@pytest.mark.parametrize(
    ("settings", "given", "expected"),
    [
        (StillSettings, {"view": -1}, "still.view: expected held_out or 0 to 7, not -1"),
        (StillSettings, {"height": 0}, "still.height: expected at least 1, not 0"),
        (VideoSettings, {"height": 15}, "video.height: expected at least 16, not 15"),
        (VideoSettings, {"max_seconds": 0}, "video.max_seconds: expected more than 0, not 0"),
    ],
)
def test_what_cannot_be_shown(
    tiny_scene: Scene, settings: type[Any], given: dict[str, int], expected: str
) -> None:
    with pytest.raises(DevrfError) as caught:
        settings(**given).camera(Viewpoints.of(tiny_scene))
    assert str(caught.value) == expected


def test_colour_and_depth_of_any_size(
    learned: tuple[CanonicalStage, Trainer], tiny_scene: Scene, reference: Callable[..., Any]
) -> None:
    model, camera = (
        learned[0].scene_model,
        StillSettings(view=2, height=31).camera(Viewpoints.of(tiny_scene)),
    )
    color, depth = still(Renderer(model), camera, 0.0, 0.0)
    assert color.shape == depth.shape == (31, 41, 3)
    seen = reference(model, camera.image_rays(0), 0.0, torch.zeros(3))
    torch.testing.assert_close(color.view(-1, 3), seen.color.clamp(0, 1))
    # Where nothing is, the colour is that of the background, and the depth is white.
    nothing = seen.opacity.view(31, 41) == 0
    assert nothing.any() and not color[nothing].any() and (depth[nothing] == 1).all()
