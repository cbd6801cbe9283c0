"""Datamodules of forward-facing scenes: from disk, and embedded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from devrf.data import flow_source
from devrf.data.flow_source import with_flow
from devrf.data.forward import ForwardFacingDataModule
from devrf.data.procedural_forward import ProceduralForwardDataModule
from devrf.scenes.export import export
from devrf.scenes.scene import OpticalFlow, Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ProceduralForwardDataModule(
        "toy", width=24, height=16, static_views=7, train_views=2, frames=2, supersample=1
    ).scene


def test_the_embedded_scene_is_what_it_was_told_to_be(scene):
    assert (scene.name, scene.kind) == ("toy", "forward")
    assert scene.static.train.pixels.shape == (7, 16, 24, 3)
    assert len(scene.static.test) == 1 and len(scene.dynamic.train) == 4


def test_a_scene_from_disk_with_its_flow_or_without(scene, tmp_path):
    export(scene, tmp_path / "toy")
    read = ForwardFacingDataModule(tmp_path / "toy").scene
    assert read.name == "toy" and read.fingerprint != ""
    ours, flow = scene.dynamic.train.flow, read.dynamic.train.flow
    assert ours is not None and flow is not None and torch.equal(flow.vectors, ours.vectors)
    bare = ForwardFacingDataModule(tmp_path / "toy", name="bare", flow="none").scene
    assert bare.name == "bare" and bare.dynamic.train.flow is None


def test_flow_is_estimated_only_where_it_is_asked_for(scene, monkeypatch):
    train = scene.dynamic.train
    bare = replace(scene, dynamic=replace(scene.dynamic, train=replace(train, flow=None)))
    made = OpticalFlow(torch.ones(4, 16, 24, 2), torch.ones(4, 16, 24, dtype=torch.bool))
    asked: list[str] = []

    def estimate(views: object, method: str, cache: Path | None) -> OpticalFlow:
        asked.append(method)
        return made

    monkeypatch.setattr(flow_source, "estimate_flow", estimate)
    assert with_flow(scene, "auto", None) is scene and with_flow(bare, "none", None) is bare
    assert with_flow(bare, "files", None) is bare and asked == []
    assert with_flow(bare, "raft", None).dynamic.train.flow is made
    assert with_flow(scene, "dis", None).dynamic.train.flow is made
    assert with_flow(bare, "auto", None).dynamic.train.flow is made
    assert asked == ["raft", "dis", "dis"]
