"""The facts of a scene, as data and as text."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from devrf.apps.inspection.advice import Advice
from devrf.apps.inspection.report import FlowFacts, as_text, inspect_scene, inspection_text
from devrf.geometry.box import Box
from devrf.scenes.scene import OpticalFlow, Scene


def test_the_sets_of_a_scene(tiny_scene: Scene) -> None:
    found = inspect_scene(tiny_scene)
    counts = [(f.name, len(f.views), f.cameras, f.frames) for f in found.sets]
    assert counts == [
        ("static training set", 8, 8, 1),
        ("static test set", 2, 2, 1),
        ("dynamic training set", 6, 2, 3),
        ("dynamic test set", 3, 1, 3),
    ]
    assert {(f.views.width, f.views.height, f.masked_share) for f in found.sets} == {(24, 18, None)}
    alpha = tiny_scene.static.test.pixels[..., 3]
    assert found.sets[1].alpha_share == pytest.approx(float((alpha > 127).float().mean()))


def test_cameras_by_hand(tiny_scene: Scene) -> None:
    # One camera at the origin and seven 4 away, around a box whose middle is 3 away along x.
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
    ("times", "distinct", "even"),
    [
        ([0, 0, 0.5, 0.5, 1, 1], (0.0, 0.5, 1.0), True),
        ([0, 0, 0.25, 0.25, 1, 1], (0.0, 0.25, 1.0), False),
        ([0.5, 0.5, 0.7500001, 0.75, 1, 1], (0.5, 0.75, 1.0), True),
    ],
)
def test_times(
    tiny_scene: Scene, times: list[float], distinct: tuple[float, ...], even: bool
) -> None:
    train = replace(tiny_scene.dynamic.train, times=torch.tensor(times))
    scene = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=train))
    found = inspect_scene(scene)
    assert (found.times, found.even) == (distinct, even)


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
    alpha = tiny_scene.dynamic.train.pixels[later, ..., 3] > 127
    found = inspect_scene(with_flow(tiny_scene, OpticalFlow(vectors, valid))).flow
    share = float((alpha & valid[later]).sum()) / float(alpha.sum())
    assert found == FlowFacts(4, 0.5, pytest.approx(share), pytest.approx(2.0), pytest.approx(5.0))
    assert inspect_scene(with_flow(tiny_scene, None)).flow is None


def test_the_report_on_a_terminal_and_in_a_log(tiny_scene: Scene) -> None:
    advice = (Advice("r_001.png", "one [colour] all over", "look at it"),)
    found = replace(inspect_scene(tiny_scene), advice=advice)
    report = inspection_text(found, [("checkpoint", "1.6 GB", "displacements 1.6 GB")])
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(report)
    log = as_text(report)
    for shown in (console.export_text(), log):
        for part in ("robot, inward-facing", "static train", "24 x 18", "1.6 GB", str(advice[0])):
            assert part in shown
    # Aligned columns, no line broken, no trailing space.
    rows = [line for line in log.splitlines() if "24 x 18" in line]
    assert len(rows) == 4 and len({line.index("24 x 18") for line in rows}) == 1
    assert all(line == line.rstrip() for line in log.splitlines())
