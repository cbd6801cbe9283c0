"""Which space an inward-facing scene is learned in, and what a given box means."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.space import WORLD, Space
from devrf.scenes.export import export
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.procedural import ProceduralScene, moved
from devrf.scenes.scene import Bounds, Scene, Views
from devrf.scenes.space import NEAR_SHARE, SHELL, dynamic_only, inward_space

PLACES = torch.tensor([[0.0, 0, 0], [0.3, 0, 0]])
BOX = Box((-0.5, -0.4, -0.3), (0.6, 0.7, 0.8))


def chosen(views: Views, choice: Any = "auto", **options: Any) -> tuple[Space, Bounds]:
    return inward_space(choice, views, views, [views], **options)


def test_mattes_and_a_given_box_mean_the_world(ball_views: Callable[..., Views]) -> None:
    space, bounds = chosen(ball_views(PLACES, 0.4))
    assert space == WORLD and bounds.reason == "the images have mattes" and not bounds.limited
    space, bounds = chosen(ball_views(PLACES, 0.4, channels=3), box=BOX)
    assert space == WORLD and bounds.reason == "data.box is given"
    assert bounds.box == BOX and bounds.limited and "data.box" in bounds.source


def test_without_mattes_the_scene_has_no_end(ball_views: Callable[..., Views]) -> None:
    views = ball_views(PLACES, 0.4, channels=3)
    space, bounds = chosen(views)
    assert isinstance(space, ContractedSpace) and space.shell == SHELL
    assert bounds.reason == "the images have no mattes, data.box is not given"
    assert bounds.box == space.box and bounds.far == math.inf
    # The inner box is what all cameras see: in their pictures as a whole.
    assert space.inner(bounds.box).longest < 0.75 * bounds.box.longest
    nearest = float(views.cameras.positions.norm(dim=1).min())
    assert bounds.near == pytest.approx(NEAR_SHARE * nearest, rel=1e-3)


def test_opaque_mattes_say_nothing(ball_views: Callable[..., Views]) -> None:
    views = ball_views(PLACES, 0.4)
    pixels = views.pixels.clone()
    pixels[..., 3] = 255
    assert not chosen(replace(views, pixels=pixels))[0].is_linear


def test_a_given_box_is_the_inner_box(ball_views: Callable[..., Views]) -> None:
    views = ball_views(PLACES, 0.4)
    space, bounds = chosen(views, "contracted", box=BOX, near=0.2)
    assert space.inner(bounds.box) == BOX and bounds.near == 0.2
    wider = chosen(ball_views(PLACES, 0.4, channels=3), bound_scale=2.0)[1].box
    assert wider.longest == pytest.approx(
        2 * chosen(ball_views(PLACES, 0.4, channels=3))[1].box.longest
    )
    with pytest.raises(DevrfError, match="data.near"):
        chosen(views, "contracted", near=math.inf)


def test_in_a_room_every_ray_meets_something(tiny_room: Scene) -> None:
    for capture in (tiny_room.static, tiny_room.dynamic):
        for views in (capture.train, capture.test):
            assert not views.has_alpha
            assert views.depth is not None and bool(views.depth.isfinite().all())
    assert not tiny_room.space.is_linear
    # The room stands still while the robot moves.
    flow = tiny_room.dynamic.train.flow
    assert flow is not None and bool(flow.valid[2:].all()) and not bool(flow.valid[:2].any())
    still = (flow.vectors[2:].norm(dim=-1) < 1e-3).float().mean()
    assert 0.5 < float(still) < 1


def test_nothing_in_the_room_moves(tiny_room_recipe: ProceduralScene) -> None:
    shape = tiny_room_recipe.filmed()
    wall = torch.tensor([[6.0, 1.0, 1.0], [0.5, 3.0, -1.1]])
    assert torch.equal(moved(shape, wall, 0.0, 1.0), wall)


def test_a_room_reads_back_as_it_was_written(tiny_room: Scene, tmp_path: Path) -> None:
    export(tiny_room, tmp_path / "room")
    again = BlenderReader(tmp_path / "room").read()
    assert torch.equal(again.static.train.pixels, tiny_room.static.train.pixels)
    assert again.bounds.reason == tiny_room.bounds.reason
    inner, known = again.space.inner(again.bounds.box), tiny_room.space.inner(tiny_room.bounds.box)
    torch.testing.assert_close(torch.tensor(inner.low), torch.tensor(known.low))


def test_methods_that_see_the_moving_views_alone_stay_endless(tiny_room: Scene) -> None:
    assert not dynamic_only(tiny_room).space.is_linear


def test_surroundings_are_checked(tiny_room_recipe: ProceduralScene) -> None:
    with pytest.raises(DevrfError, match=r"data\.surroundings: expected one of none, room"):
        replace(tiny_room_recipe, surroundings="garden")()


def test_fine_paint_has_smaller_patterns(tiny_room_recipe: ProceduralScene) -> None:
    with pytest.raises(DevrfError, match=r"data\.texture: expected one of soft, fine"):
        replace(tiny_room_recipe, texture="coarse")()
    room = tiny_room_recipe.filmed()
    fine = replace(tiny_room_recipe, texture="fine").filmed()
    # Half a wavelength of the finest wave along a wall changes the fine paint a lot.
    wall = torch.tensor([[-6.0, 0.3, 1.0], [-6.0, 0.3 + 0.14, 1.0]])
    changes = [
        shape.color(shape.material(wall, 0.0)).diff(dim=0).abs().max() for shape in (room, fine)
    ]
    assert changes[1] > 2 * changes[0]
