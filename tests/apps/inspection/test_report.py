"""The facts of a scene, as text; where boxes and cameras are in the world."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from devrf.apps.inspection.advice import advice_on
from devrf.apps.inspection.layout import box_points, common_up, widest_gap
from devrf.apps.inspection.report import (
    as_text,
    flow_facts,
    image_facts,
    inspection_text,
    scene_facts,
)
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.scene import OpticalFlow, Views


def test_the_sets_of_a_scene(tiny_scene):
    rows = image_facts(tiny_scene)
    assert [row[:4] for row in rows] == [
        ("static training set", "8", "8 x 1", "24 x 18"),
        ("static test set", "2", "2 x 1", "24 x 18"),
        ("dynamic training set", "6", "2 x 3", "24 x 18"),
        ("dynamic test set", "3", "1 x 3", "24 x 18"),
    ]
    inside = float((tiny_scene.static.test.pixels[..., 3] > 127).float().mean())
    assert rows[1][4:6] == (f"cover {100 * inside:.0f} %", "no")


def test_a_set_of_two_sizes_names_both_and_has_no_masks(two_sizes, tiny_scene):
    row = image_facts(two_sizes)[0]
    assert (row[3], row[5]) == ("18 x 18, 24 x 16", "no")
    whole = tiny_scene.static.train.pixels[..., 3] > 127
    left = [whole[k, :18, :18] if k % 2 == 0 else whole[k, :16] for k in range(8)]
    assert row[4] == f"cover {100 * sum(float(m.float().mean()) for m in left) / 8:.0f} %"
    assert not [a for a in advice_on(two_sizes) if "mask" in a.problem]


@pytest.mark.parametrize(
    ("times", "text"),
    [
        ([0, 0, 0.5, 0.5, 1, 1], "3 from 0 to 1, evenly spaced"),
        ([0, 0, 0.25, 0.25, 1, 1], "3 from 0 to 1, unevenly spaced"),
        ([0.5, 0.5, 0.7500001, 0.75, 1, 1], "3 from 0.5 to 1, evenly spaced"),
    ],
)
def test_times(tiny_scene, times, text):
    train = replace(tiny_scene.dynamic.train, times=torch.tensor(times))
    scene = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=train))
    assert dict(scene_facts(scene))["times"] == text


def test_flow_by_hand(tiny_scene):
    views: Views = tiny_scene.dynamic.train
    vectors, valid = torch.zeros(6, 18, 24, 2), torch.zeros(6, 18, 24, dtype=torch.bool)
    later = (views.times > 0).nonzero()[:, 0]
    assert len(later) == 4
    valid[later, :9] = True  # half of each image that has a frame before it
    vectors[later[0]] = torch.tensor([3.0, 4.0])
    vectors[later[1:]] = torch.tensor([0.0, 1.0])
    alpha = views.pixels[later, ..., 3] > 127
    share = 100 * float((alpha & valid[later]).sum()) / float(alpha.sum())
    assert flow_facts(replace(views, flow=OpticalFlow(vectors, valid))) == (
        f"4 images, valid on 50 % of the pixels ({share:.0f} % of the alpha masks), "
        "mean 2.0 px, longest 5.0 px"
    )
    assert flow_facts(replace(views, flow=None)) == "none"


def test_the_report_on_a_terminal_and_in_a_log(tiny_scene):
    named = replace(tiny_scene, name="a [bold] robot")
    report = inspection_text(named, [("checkpoint", "1.6 GB", "displacements 1.6 GB")])
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(report)
    log = as_text(report)
    for shown in (console.export_text(), log):
        for part in ("a [bold] robot, inward-facing", "static train", "24 x 18", "1.6 GB"):
            assert part in shown
    # Aligned columns, no line broken, no trailing space.
    rows = [line for line in log.splitlines() if "24 x 18" in line]
    assert len(rows) == 4 and len({line.index("24 x 18") for line in rows}) == 1
    assert all(line == line.rstrip() for line in log.splitlines())


def ring(angles, height=1.0):
    at = torch.tensor(angles).deg2rad()
    positions = torch.stack([3 * at.cos(), 3 * at.sin(), torch.full_like(at, height)], dim=1)
    middle = torch.zeros(len(angles), 3)
    return Cameras.looking_at(positions, middle, focal=20.0, width=15, height=10)


@pytest.mark.parametrize(
    ("angles", "height", "gap"),
    [
        ([0, 90, 180, 270], 1.0, 90),
        ([0, 45, 90, 225, 270, 315], 1.0, 135),
        ([7], 1.0, 360),
        ([0, 10, 20], 60.0, None),  # straight above
    ],
)
def test_the_widest_gap_by_hand(tiny_scene, cube, angles, height, gap):
    views = replace(tiny_scene.static.train, cameras=ring(angles, height))
    scene = replace(
        tiny_scene,
        static=replace(tiny_scene.static, train=views),
        bounds=replace(tiny_scene.bounds, box=cube),
    )
    assert widest_gap(scene) == (gap if gap is None else pytest.approx(gap, abs=0.01))


def test_up_of_level_cameras():
    up = common_up(ring([0, 70, 200]))
    assert up is not None
    torch.testing.assert_close(up, torch.tensor([0.0, 0.0, 1.0]), atol=1e-5, rtol=0)
    # Cameras that are each rolled by another angle agree on none.
    cameras = ring([0, 90, 180, 270])
    poses = cameras.camera_to_world.clone()
    poses[:2, :, :2] = poses[:2, :, [1, 0]] * torch.tensor([1.0, -1.0])
    assert common_up(replace(cameras, camera_to_world=poses)) is None


def test_an_unbounded_box_is_cut_off_at_twice_the_near_plane(tiny_scene):
    space = NormalizedDevice(24, 18, (12.0, 9.0), near=1.0)
    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    scene = replace(tiny_scene, kind="forward", space=space)
    corners = box_points(scene, box, (2, 2, 2))
    # With these focal lengths the image at depth 1 is 2 wide, at depth 2 twice that.
    torch.testing.assert_close(corners[1, 1, 0], torch.tensor([1.0, 1.0, -1.0]))
    torch.testing.assert_close(corners[0, 1, 1], torch.tensor([-2.0, 2.0, -2.0]))
