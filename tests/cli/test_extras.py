"""A package that a setting needs and that is not installed is named before anything is read."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ["logger=tensorboard"],
            'logger=tensorboard: tensorboard is not installed; run pip install "devrf[tensorboard]"'
            ", or set logger=csv",
        ),
        (
            ["data=inward", "data.root=nowhere", "data.flow=raft"],
            'data.flow=raft: torchvision is not installed; run pip install "devrf[raft]", or set '
            "data.flow=dis",
        ),
    ],
)
def test_the_extra_is_named_first(devrf, tmp_path, monkeypatch, arguments, expected):
    monkeypatch.setattr("devrf.cli.extras.find_spec", lambda package: None)
    outcome = devrf(*arguments)
    assert (outcome.status, outcome.err) == (2, f"devrf: {expected}\n")
    assert not list(tmp_path.iterdir())


def test_flow_that_was_estimated_before_needs_no_estimator(devrf, tmp_path, monkeypatch):
    monkeypatch.setattr("devrf.cli.extras.find_spec", lambda package: None)
    (tmp_path / "flow.npz").touch()
    cached = ("data=inward", "data.root=nowhere", "data.flow=raft", "data.flow_cache=flow.npz")
    outcome = devrf(*cached)
    assert outcome.err.startswith("devrf: nowhere: no such folder")
