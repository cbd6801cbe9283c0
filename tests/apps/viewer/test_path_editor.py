"""Keyframes as they are collected."""

from __future__ import annotations

import pytest
import torch

from devrf.apps.keyframes import Keyframe
from devrf.apps.viewer.paths import PathEditor
from devrf.errors import DevrfError

POSE = torch.eye(3, 4)


def test_keyframes_follow_one_another():
    editor = PathEditor()
    for time, gap in ((0.1, 5.0), (0.2, 2.0), (0.3, 0.5)):
        editor.add(POSE, 50.0, time, gap)
    assert [one.seconds for one in editor.keyframes] == [0, 2, 2.5]
    editor.remove_last()
    path = editor.path(1.5, 24.0)
    assert [one.time for one in path.keyframes] == [0.1, 0.2]
    assert (path.aspect, path.fps, path.duration) == (1.5, 24.0, 2.0)


def test_one_keyframe_is_no_path():
    editor = PathEditor()
    editor.add(POSE, 50.0, 0.0, 1.0)
    with pytest.raises(DevrfError, match="a path needs two keyframes"):
        editor.path(1.0, 24.0)


def test_other_keyframes_begin_at_zero():
    editor = PathEditor()
    editor.replace((Keyframe(POSE, 50.0, 0.0, 3.0), Keyframe(POSE, 50.0, 1.0, 7.0)))
    assert [one.seconds for one in editor.keyframes] == [0, 4]
    editor.replace(())
    editor.remove_last()
    assert editor.keyframes == ()
