"""Where optical flow comes from, and which image it leads to."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.data import flow
from devrf.data.flow import previous_images, with_flow, with_forward_flow
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import OpticalFlow, Views


def grey(count: int) -> Views:
    """So many images by a camera that stands still."""
    positions = torch.tensor([[4.0, 0, 0]]).expand(count, 3)
    cameras = Cameras.looking_at(positions, torch.zeros(count, 3), focal=60.0, width=40, height=32)
    pixels = torch.full((count, 32, 40, 3), 128, dtype=torch.uint8)
    return Views(
        pixels, cameras, torch.linspace(0, 1, count), torch.arange(count), tuple("abcdef"[:count])
    )


def test_flow_is_estimated_only_where_it_is_asked_for(tiny_scene, monkeypatch):
    train = tiny_scene.dynamic.train
    bare = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=replace(train, flow=None)))
    made = OpticalFlow(torch.ones(6, 18, 24, 2), torch.ones(6, 18, 24, dtype=torch.bool))
    asked: list[str] = []
    monkeypatch.setattr(flow, "estimate_flow", lambda views, how, cache: asked.append(how) or made)
    assert with_flow(tiny_scene, "auto", None) is tiny_scene
    assert with_flow(tiny_scene, "files", None) is tiny_scene
    assert with_flow(bare, "auto", None) is bare and with_flow(bare, "none", None) is bare
    with pytest.raises(DevrfError, match=r"data\.flow"):
        with_flow(bare, "files", None)
    assert asked == []
    assert with_flow(bare, "raft", None).dynamic.train.flow is made
    assert with_flow(tiny_scene, "dis", None).dynamic.train.flow is made
    assert asked == ["raft", "dis"]


@pytest.mark.parametrize(
    ("times", "view", "previous"),
    [
        # Fixed cameras, all at one moment, then all at the next; in another order.
        ([0.0, 0.0, 0.5, 0.5, 1.0, 1.0], [0, 1, 0, 1, 0, 1], [0, 1, 0, 1, 2, 3]),
        ([1.0, 0.0, 0.5, 0.0, 1.0, 0.5], [0, 0, 0, 1, 1, 1], [2, 1, 1, 3, 5, 3]),
        # A moving camera follows time alone.
        ([0.0, 0.3, 0.1, 1.0], [0, 1, 2, 3], [0, 2, 0, 1]),
        # A late start has no image at rest to lead to.
        ([0.4, 0.4, 0.8, 0.8], [0, 1, 0, 1], [0, 1, 0, 1]),
        # View 1 lacks frame 1; the only image of that frame is view 0's.
        ([0.0, 0.0, 0.5, 1.0, 1.0], [0, 1, 0, 0, 1], [0, 1, 0, 2, 4]),
    ],
)
def test_the_image_one_frame_earlier(times, view, previous):
    views = replace(grey(len(times)), times=torch.tensor(times), view=torch.tensor(view))
    assert previous_images(views).tolist() == previous
    assert [(i, p) for i, p in enumerate(previous) if p != i] == frame_pairs(views)


def test_flow_files_of_a_camera_that_left_a_frame_out_do_not_count(tiny_scene, caplog):
    train = tiny_scene.dynamic.train
    kept = [k for k in range(len(train)) if not (train.frames[k] == 1 and train.view[k] == 1)]
    lacking = replace(train[torch.tensor(kept)], flow=None)
    whole = OpticalFlow(torch.ones(5, 18, 24, 2), torch.ones(5, 18, 24, dtype=torch.bool))
    of_files = replace(lacking, flow=whole)
    scene = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=of_files))
    pairs = frame_pairs(of_files)
    backward = with_flow(scene, "auto", None).dynamic.train.flow
    forward = with_forward_flow(scene, "auto", None, whole).dynamic.train.forward_flow
    for number, flow_of_files in enumerate((backward, forward)):
        valid = flow_of_files.valid.flatten(1).all(dim=1).nonzero()[:, 0].tolist()
        assert valid == sorted(pair[number] for pair in pairs) and len(valid) == 2
    assert "one frame earlier" in caplog.text and "one frame later" in caplog.text
