"""What an inspection says of a scene, as data and in words."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from devrf.artifacts.advice import Advice
from devrf.artifacts.inspection import FlowFacts, TimesFacts, inspect_scene
from devrf.artifacts.inspection_text import plain, size, tables
from devrf.cli.memory import Budget, StageMemory
from devrf.geometry.box import Box
from devrf.scenes.scene import OpticalFlow, Scene

BUDGET = Budget(
    scene={"images": 3_000_000},
    canonical=StageMemory({"density and features": 40_000_000}, {"a batch": 2_000_000}),
    deformation=StageMemory({"displacements": 1_600_000_000}, {"a batch": 5_000_000}),
    fields={"displacements": 1_600_000_000},
    checkpoint={"displacements": 1_600_000_000},
    files={},
)


def test_the_sets_of_a_scene(tiny_scene: Scene) -> None:
    found = inspect_scene(tiny_scene)
    assert (found.name, found.kind, found.background) == ("robot", "inward", "white")
    counts = [(f.name, f.images, f.views, f.frames) for f in found.sets]
    assert counts == [
        ("static train", 8, 8, 1),
        ("static test", 2, 2, 1),
        ("dynamic train", 6, 2, 3),
        ("dynamic test", 3, 1, 3),
    ]
    assert {(f.width, f.height, f.left_out) for f in found.sets} == {(24, 18, None)}
    alpha = tiny_scene.static.test.pixels[..., 3]
    assert found.sets[1].mattes == pytest.approx(float((alpha > 127).float().mean()))


def test_cameras_by_hand(tiny_scene: Scene) -> None:
    # A box 3 away from the middle of the cameras' sphere along x, seen from there and from 1 up.
    pose = torch.eye(3, 4).repeat(8, 1, 1)
    pose[:, 2, 3] = torch.tensor([0.0] + 7 * [4.0])
    views = tiny_scene.static.train
    focal = torch.full((8, 2), 30.0)
    focal[5] = torch.tensor([20.0, 40.0])
    cameras = replace(views.cameras, camera_to_world=pose, focal=focal)
    box = Box((2.0, -1.0, -1.0), (4.0, 1.0, 1.0))
    scene = replace(
        tiny_scene,
        static=replace(tiny_scene.static, train=replace(views, cameras=cameras)),
        bounds=replace(tiny_scene.bounds, box=box),
    )
    facts = inspect_scene(scene).sets[0]
    assert facts.focal == (20.0, 40.0)
    assert facts.distance == pytest.approx((3.0, (3 + 7 * 5) / 8, 5.0))


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([0, 0, 0.5, 0.5, 1, 1], TimesFacts(3, 0.0, 1.0, True)),
        ([0, 0, 0.25, 0.25, 1, 1], TimesFacts(3, 0.0, 1.0, False)),
        ([0.5, 0.5, 0.7500001, 0.75, 1, 1], TimesFacts(3, 0.5, 1.0, True)),
    ],
)
def test_times(tiny_scene: Scene, times: list[float], expected: TimesFacts) -> None:
    train = replace(tiny_scene.dynamic.train, times=torch.tensor(times))
    scene = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=train))
    assert inspect_scene(scene).times == expected


def with_flow(scene: Scene, flow: OpticalFlow | None) -> Scene:
    train = replace(scene.dynamic.train, flow=flow)
    return replace(scene, dynamic=replace(scene.dynamic, train=train))


def test_flow_by_hand(tiny_scene: Scene) -> None:
    vectors, valid = torch.zeros(6, 18, 24, 2), torch.zeros(6, 18, 24, dtype=torch.bool)
    later = (tiny_scene.dynamic.train.times > 0).nonzero()[:, 0]
    assert len(later) == 4
    valid[later, :9] = True  # half of each image that has a frame before it
    vectors[later[0]] = torch.tensor([3.0, 4.0])
    vectors[later[1:]] = torch.tensor([0.0, 1.0])
    matte = tiny_scene.dynamic.train.pixels[later, ..., 3] > 127
    found = inspect_scene(with_flow(tiny_scene, OpticalFlow(vectors, valid))).flow
    share = float((matte & valid[later]).sum()) / float(matte.sum())
    assert found == FlowFacts(4, 0.5, pytest.approx(share), pytest.approx(2.0), pytest.approx(5.0))


def test_no_flow(tiny_scene: Scene) -> None:
    found = inspect_scene(with_flow(tiny_scene, None))
    assert found.flow is None
    assert "  optical flow     none" in plain(found, BUDGET).splitlines()


def test_in_words(tiny_scene: Scene) -> None:
    advice = (Advice("r_001.png", "one [colour] all over", "look at it"),)
    found = replace(inspect_scene(tiny_scene), advice=advice)
    text = plain(found, BUDGET)
    assert "robot, inward-facing, white background" in text
    assert "3 from 0 to 1, evenly spaced" in text
    assert "24 x 18" in text
    assert "deformation stage" in text and "1.6 GB" in text and "42 MB" in text
    assert text.endswith("problems found: 1\n  r_001.png: one [colour] all over; look at it")
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(tables(found, BUDGET))
    shown = console.export_text()
    for words in ("static train", "1.6 GB", "one [colour] all over; look at it"):
        assert words in shown


@pytest.mark.parametrize(
    ("count", "words"),
    [(12, "12 B"), (3_400, "3.4 kB"), (25e6, "25 MB"), (2.84e9, "2.8 GB"), (46e9, "46 GB")],
)
def test_sizes_in_words(count: float, words: str) -> None:
    assert size(count) == words
