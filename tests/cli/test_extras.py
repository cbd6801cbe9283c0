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
        (
            ["stage=export"],
            'stage=export: skimage is not installed; run pip install "devrf[export]"',
        ),
    ],
)
def test_the_extra_is_named_first(devrf, tmp_path, monkeypatch, arguments, expected):
    monkeypatch.setattr("devrf.cli.extras.find_spec", lambda package: None)
    outcome = devrf(*arguments)
    assert (outcome.status, outcome.err) == (2, f"devrf: {expected}\n")
    assert not list(tmp_path.iterdir())


def test_usd_needs_a_package_that_the_other_formats_do_not(devrf, monkeypatch):
    monkeypatch.setattr("devrf.cli.extras.find_spec", lambda package: package != "pxr" or None)
    outcome = devrf("stage=export", "export.format=usd")
    assert (outcome.status, outcome.err) == (
        2,
        'devrf: export.format=usd: pxr is not installed; run pip install "devrf[export]", or set '
        "export.format=gltf\n",
    )
    assert "no such checkpoint" in devrf("stage=export").err


def test_flow_that_was_estimated_before_needs_no_estimator(devrf, tmp_path, monkeypatch):
    monkeypatch.setattr("devrf.cli.extras.find_spec", lambda package: None)
    (tmp_path / "flow.npz").touch()
    cached = ("data=inward", "data.root=nowhere", "data.flow=raft", "data.flow_cache=flow.npz")
    outcome = devrf(*cached)
    assert outcome.err.startswith("devrf: nowhere: no such folder")
