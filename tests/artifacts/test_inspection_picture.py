"""The page of an inspection: lines where points project to, tiles, colours of flow."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch
from PIL import Image

from devrf.artifacts.colors import UNKNOWN, flow_colors, flow_wheel
from devrf.artifacts.drawing import Lines, Projection, draw
from devrf.artifacts.inspection_picture import (
    evenly,
    flow_scale,
    inspection_picture,
    write_inspection_picture,
)
from devrf.artifacts.scene_sketch import PAPER, box_edges, frusta, grid_step, sketches
from devrf.artifacts.tiles import WIDTH, fitting, font, shown
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.scene import Scene


def test_a_projection_by_hand() -> None:
    points = torch.tensor([[-2.0, 0.0, 0.0], [2.0, 0.0, 1.0]])
    toward, up = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    projection = Projection.onto(points, toward, up, 120, 50, margin=10)
    # 4 across and 1 up: 25 pixels a unit are wide enough, and 30 would be high enough.
    assert projection.scale == pytest.approx(25)
    pixels, nearness = projection.pixels(torch.tensor([[-2.0, 0, 0], [2, 0, 1], [0, -3, 0.5]]))
    expected = torch.tensor([[10.0, 37.5], [110.0, 12.5], [60.0, 25.0]])
    torch.testing.assert_close(pixels, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(nearness, torch.tensor([0.0, 0.0, 3.0]))


def test_a_line_is_drawn_where_it_projects_and_far_ones_are_paler() -> None:
    axes = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    projection = Projection(axes, torch.zeros(3), 10.0, 40, 40)
    near = torch.tensor([[[-1.5, 1.0, 1.0], [1.5, 1.0, 1.0]]])
    far = near * torch.tensor([1.0, -1.0, -1.0])
    image = draw([Lines(torch.cat([near, far]), (0, 0, 0), 5.0)], projection, (255, 255, 255))
    assert image.size == (40, 40)
    assert image.getpixel((20, 10))[0] < 10
    # At the far end 0.4 of the ink is left.
    assert image.getpixel((20, 30))[0] == pytest.approx(153, abs=10)
    assert image.getpixel((20, 20)) == (255, 255, 255)


def dark(image: Image.Image, x: float, y: float) -> bool:
    """Whether something was drawn within a pixel of (x, y)."""
    found = [
        image.getpixel((i, j))
        for i in range(int(x) - 1, int(x) + 2)
        for j in range(int(y) - 1, int(y) + 2)
    ]
    return any(sum(p) < sum(PAPER) - 120 for p in found)  # type: ignore[arg-type,misc]


def forward_scene(scene: Scene) -> Scene:
    """The tiny scene as if it lived in NDC, its cameras side by side."""
    bounds = replace(scene.bounds, box=Box((-1.2, -1.1, -1.0), (1.2, 1.1, 1.0)), motion=None)

    def facing(count: int) -> torch.Tensor:
        pose = torch.eye(3, 4).repeat(count, 1, 1)
        pose[:, 0, 3] = 0.1 * torch.arange(count)
        return pose

    def moved(capture):
        return replace(
            capture,
            **{
                name: replace(v, cameras=replace(v.cameras, camera_to_world=facing(len(v))))
                for name, v in (("train", capture.train), ("test", capture.test))
            },
        )

    return replace(
        scene,
        kind="forward",
        space=NormalizedDevice(24, 18, (24.0, 24.0)),
        bounds=bounds,
        static=moved(scene.static),
        dynamic=moved(scene.dynamic),
    )


@pytest.mark.parametrize("kind", ["inward", "forward"])
def test_the_boxs_corners_are_drawn_where_they_project(tiny_scene: Scene, kind: str) -> None:
    scene = tiny_scene if kind == "inward" else forward_scene(tiny_scene)
    for sketch in sketches(scene, 500, 400):
        assert sketch.image.size == (500, 400)
        pixels, _ = sketch.projection.pixels(box_edges(scene).reshape(-1, 3))
        assert len(pixels) == 24
        assert ((pixels > 20) & (pixels < torch.tensor([480, 380]))).all()
        for x, y in pixels.tolist():
            assert dark(sketch.image, x, y)


def test_edges_of_a_box(tiny_scene: Scene, cube: Box) -> None:
    scene = replace(tiny_scene, bounds=replace(tiny_scene.bounds, box=cube, motion=None))
    edges = box_edges(scene)
    assert edges.shape == (12, 2, 3)
    torch.testing.assert_close((edges[:, 1] - edges[:, 0]).norm(dim=1), torch.full((12,), 2.0))
    assert len({tuple(sorted(map(tuple, e))) for e in edges.tolist()}) == 12
    assert len(box_edges(scene, motion=True)) == 0


def test_a_camera_is_a_pyramid_that_opens_where_it_looks() -> None:
    cameras = Cameras(
        torch.eye(3, 4)[None], torch.tensor([[10.0, 10.0]]), torch.tensor([[10.0, 5.0]]), 20, 10
    )
    lines = frusta(cameras, depth=2.0)
    assert lines.shape == (10, 2, 3)
    # The image's top left corner: 10 left and 5 up at focal length 10, 2 away along -z.
    torch.testing.assert_close(lines[0], torch.tensor([[0.0, 0, 0], [-2.0, 1.0, -2.0]]))
    # The tick above it shows which way is up.
    torch.testing.assert_close(lines[8, 1], torch.tensor([0.0, 1.4, -2.0]))


def test_the_page_of_a_scene(tiny_scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "images" / "inspect.png"
    write_inspection_picture(path, tiny_scene)
    page = iio.imread(path)
    assert page.ndim == 3 and page.shape[1:] == (WIDTH, 3)
    assert [p.name for p in path.parent.iterdir()] == ["inspect.png"]
    train = replace(tiny_scene.dynamic.train, flow=None)
    still = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=train))
    # Without flow a title and two rows of tiles are missing.
    assert inspection_picture(still).height < page.shape[0] - 2 * 180


def test_the_page_of_a_forward_scene_and_of_a_moving_camera(tiny_scene: Scene) -> None:
    scene = forward_scene(tiny_scene)
    train = replace(scene.dynamic.train, view=torch.arange(6), times=torch.linspace(0, 1, 6))
    moving = replace(scene, dynamic=replace(scene.dynamic, train=train))
    # One row of six images, and one of the flow of the five that have a frame before them.
    assert inspection_picture(moving).height < inspection_picture(scene).height


def test_flow_as_colours() -> None:
    vectors = torch.tensor([[[2.0, 0.0], [0.0, -2.0], [-9.0, 0.0], [0.0, 0.0], [7.0, 7.0]]])
    valid = torch.tensor([[True, True, True, True, False]])
    colors = flow_colors(vectors, valid, full=2.0)
    assert colors.shape == (1, 5, 3)
    expected = torch.tensor(
        [
            [0.9, 0.0, 0.0],  # to the right: red
            [0.45, 0.9, 0.0],  # up: a quarter turn further
            [0.0, 0.9, 0.9],  # to the left, as saturated as it gets
            [1.0, 1.0, 1.0],  # nowhere
            [UNKNOWN] * 3,
        ]
    )
    torch.testing.assert_close(colors[0], expected, atol=1e-5, rtol=0)


def test_the_wheel_shows_the_directions_that_it_explains() -> None:
    wheel = flow_wheel(101)
    assert torch.equal(wheel[0, 0], torch.ones(3))
    red, cyan = wheel[50, 99], wheel[50, 1]
    assert red[0] > 0.85 > 0.1 > red[1] and cyan[0] < 0.1 < 0.85 < cyan[1]
    torch.testing.assert_close(wheel[50, 50], torch.ones(3), atol=0.02, rtol=0)


def test_the_longest_hundredth_of_the_flow_does_not_count(tiny_scene: Scene) -> None:
    train = tiny_scene.dynamic.train
    vectors, valid = torch.zeros(6, 18, 24, 2), torch.ones(6, 18, 24, dtype=torch.bool)
    vectors[..., 0] = 2.0
    vectors[0, 0, 0] = torch.tensor([500.0, float("nan")])
    flow = replace(train.flow, vectors=vectors, valid=valid)  # type: ignore[type-var]
    assert flow_scale(replace(train, flow=flow)) == pytest.approx(2.0)
    assert flow_scale(replace(train, flow=replace(flow, valid=valid & False))) == 1.0


def test_mattes_are_chequered() -> None:
    pixels = torch.zeros(20, 40, 4, dtype=torch.uint8)
    pixels[:, :20] = torch.tensor([255, 0, 0, 255], dtype=torch.uint8)
    image = shown(pixels, (40, 20))
    assert image.size == (40, 20)
    assert image.getpixel((5, 5)) == (255, 0, 0)
    assert image.getpixel((25, 5)) != image.getpixel((35, 5))


def test_positions_evenly_spread() -> None:
    assert evenly(3, 6) == [0, 1, 2]
    assert evenly(50, 6) == [0, 10, 20, 29, 39, 49]


def test_the_ground_has_round_steps(tiny_scene: Scene) -> None:
    # The cameras are 4 away from the middle: 1 is the roundest number below a third of that.
    step = grid_step(tiny_scene)
    assert step / 10 ** math.floor(math.log10(step)) in (1, 2, 5)
    assert step == 1


def test_long_names_lose_their_beginning() -> None:
    assert fitting("r_000.png", 200) == "r_000.png"
    short = fitting("a_very_long_name_of_a_file_000.png", 80)
    assert short.startswith("…") and short.endswith("000.png")
    assert font(14).getlength(short) <= 80
