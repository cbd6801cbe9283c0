"""Which images one fixed camera took: found from poses that are equal up to rounding."""

from __future__ import annotations

import json
import logging
import shutil
import time
from pathlib import Path

import pytest
import torch

from devrf.data.flow import with_flow
from devrf.errors import DevrfError
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.scene import Scene
from devrf.scenes.splits import SAME_POSE, distinct_poses, parted


def test_poses_are_told_apart_up_to_rounding():
    cameras = torch.randn((3, 3, 4), generator=torch.Generator().manual_seed(0))
    # Steps of 0.6 of the least limit, which grows with the distance: near the first of its kind.
    drawn = [(0, 0), (1, 0), (0, 1), (0, 9), (1, -1), (2, 0), (0, 9)]
    poses = torch.stack([cameras[k] + 0.6 * SAME_POSE * step for k, step in drawn])
    assert distinct_poses(poses).tolist() == [0, 1, 0, 2, 1, 3, 2]


def test_poses_across_a_line_are_told_apart_in_seconds():
    """Along one line all are the same: half a minute, were that line the one that is used."""
    numbers = torch.randn((10_000, 12), generator=torch.Generator().manual_seed(0)).double()
    line = torch.arange(2, 14).double().sqrt()
    across = numbers - (numbers @ line)[:, None] * line / (line @ line)
    began = time.perf_counter()
    assert distinct_poses(across.view(-1, 3, 4)).tolist() == list(range(10_000))
    assert time.perf_counter() - began < 10


def assert_at_rest(scene: Scene, train: int, test: int) -> None:
    """So many images of one moment, which the dynamic capture shares."""
    assert (len(scene.static.train), len(scene.static.test)) == (train, test)
    assert not scene.moves and scene.clock.times == (0.0,)
    for name in ("train", "test"):
        views = getattr(scene.static, name)
        assert getattr(scene.dynamic, name) is views
        assert views.times.tolist() == [0.0] * len(views)
        assert views.frames.tolist() == [0] * len(views)
    assert scene.bounds.motion is None
    assert with_flow(scene, "auto", None) is scene


def edit_times(root: Path, time: float | None) -> None:
    for file in root.glob("transforms*.json"):
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            frame.pop("time")
            if time is not None:
                frame["time"] = time
        file.write_text(json.dumps(content))


@pytest.mark.parametrize(("time", "said"), [(None, "no time"), (0.5, "one time")])
def test_one_folder_without_times(single_folder, caplog, time, said):
    edit_times(single_folder, time)
    with caplog.at_level(logging.INFO):
        scene = BlenderReader(single_folder).read()
    assert_at_rest(scene, 8, 3)
    lines = [record.getMessage() for record in caplog.records if "at rest" in record.getMessage()]
    assert len(lines) == 1 and f"transforms_train.json: its frames have {said}" in lines[0]


def test_a_static_folder_without_a_dynamic_one(scene_folder, refusal):
    shutil.rmtree(scene_folder.dynamic)
    assert_at_rest(BlenderReader(scene_folder.root).read(), 6, 2)
    for option in ({"frames": 2}, {"train_views": 1}):
        message = refusal(BlenderReader, scene_folder.root, **option)
        assert f"data.{next(iter(option))}" in message and "one moment" in message


def test_llff_alone(llff_folder, refusal):
    root = llff_folder.static
    scene = LlffReader(root).read()
    assert scene.kind == "forward"
    assert_at_rest(scene, 7, 2)
    assert "data.frames: 2 was asked for" in refusal(LlffReader, root, frames=2)


def test_an_llff_video(llff_folder, refusal):
    """Nine images of one camera: the eighth is held out, each has a time of its own."""
    root = llff_folder.static
    (root / "precomputed.json").write_text("{}")
    scene = LlffReader(root).read()
    assert scene.moves and scene.static.train is scene.dynamic.train
    times = torch.arange(9) / 8
    assert torch.equal(scene.dynamic.train.times, times[[0, 1, 2, 3, 4, 5, 6, 8]])
    assert scene.dynamic.test.times.tolist() == [0.875]
    assert scene.dynamic.train.pixels[:, 0, 0, 0].tolist() == [0, 1, 2, 3, 4, 5, 6, 8]
    early = LlffReader(root, monocular=True, static_until=0.25, frames=3).read()
    assert early.static.train.times.tolist() == [0.0]
    assert early.dynamic.train.times.tolist() == [0.0, 0.5, 1.0]
    assert not LlffReader(root, monocular=False).read().moves
    assert "data.train_views" in refusal(LlffReader, root, monocular=True, train_views=1)
    assert "data.monocular" in refusal(LlffReader, llff_folder.root, monocular=True)


def test_nerfstudio_without_times(tmp_path, balls):
    balls.write(tmp_path / "one", [0.5] * 9)
    assert_at_rest(NerfstudioReader(tmp_path / "one").read(), 8, 1)
    balls.write(tmp_path / "two/static", None)
    assert_at_rest(NerfstudioReader(tmp_path / "two").read(), 8, 1)


def test_what_no_list_holds_out_is_parted():
    assert parted([4, 5, 6], [7], 2, "list.json") == ([4, 5, 6], [7])
    assert parted([4, 5, 6], [], 2, "list.json") == ([4, 6], [5])
    assert parted([4, 5, 6], [], 2, "list.json", start=0) == ([5], [4, 6])
    for train, test, what in (
        ([], [7], "all images are held out; list some to learn from"),
        ([4], [], "lists one image; add more, one of them to hold out"),
        ([], [], "lists no image; add more, one of them to hold out"),
    ):
        with pytest.raises(DevrfError, match=f"list.json: {what}"):
            parted(train, test, 2, "list.json")
