"""The surface of a field at rest: where it is, which way it faces, how it is coloured."""

from __future__ import annotations

import pytest
import torch
import trimesh

from devrf.apps.export.geometry import ExportSettings
from devrf.apps.export.surface import surface_of
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.ndc import NormalizedDevice


def exported(model, cameras, **settings):
    return surface_of(model, model.surface(), cameras, ExportSettings(**settings))


def mesh_of(surface):
    return trimesh.Trimesh(surface.points.numpy(), surface.faces.numpy(), process=False)


def test_a_ball_is_where_it_is_closed_and_faces_outward(moving_ball, around):
    surface = exported(moving_ball, around)
    # Within a tenth of a voxel of 1/12: distances are not quite linear along an edge.
    assert (surface.points.norm(dim=1) - 0.5).abs().max() < 0.1 / 12
    mesh = mesh_of(surface)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * torch.pi * 0.125, rel=0.03)


def test_what_no_camera_can_reach_is_solid(of_distance, cube, around):
    hollow = of_distance(lambda points: (points.norm(dim=1) - 0.4).abs() - 0.15, cube, 25)
    mesh = mesh_of(exported(hollow, around))
    assert mesh.body_count == 1
    assert mesh.volume == pytest.approx(4 / 3 * torch.pi * 0.55**3, rel=0.03)


def test_small_pieces_are_left_out(of_distance, cube, around):
    def two(points):
        small = (points - torch.tensor([0.8, 0.0, 0.0])).norm(dim=1) - 0.12
        return torch.minimum(points.norm(dim=1) - 0.5, small)

    model = of_distance(two, cube, 25)
    assert mesh_of(exported(model, around, pieces=0.0)).body_count == 2
    assert mesh_of(exported(model, around, pieces=0.2)).body_count == 1


def test_it_has_the_colour_of_the_field(of_distance, cube, around):
    model = of_distance(lambda points: points.norm(dim=1) - 0.5, cube, 21, (0.2, 0.4, 0.9))
    for colors in ("mean", "normal"):
        found = exported(model, around, colors=colors).colors
        expected = torch.tensor([0.2, 0.4, 0.9]).expand_as(found)
        torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)


def test_a_forward_facing_surface_is_in_the_world_and_faces_the_camera(of_distance):
    space = NormalizedDevice(40, 30, (40.0, 40.0), near=2.0)
    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    # Everything further than 4 units, z' = 0, is matter.
    wall = of_distance(lambda points: -points[:, 2], box, 21, space=space)
    eye = Cameras(
        torch.eye(4)[None, :3], torch.full((1, 2), 40.0), torch.tensor([[20.0, 15.0]]), 40, 30
    )
    surface = exported(wall, eye)
    world = space.to_world(surface.points)
    torch.testing.assert_close(world[:, 2], torch.full_like(world[:, 2], -4.0))
    mesh = trimesh.Trimesh(world.numpy(), surface.faces.numpy(), process=False)
    assert (mesh.face_normals[:, 2] > 0.99).all()
    assert mesh.area == pytest.approx(4.0 * 3.0, rel=0.01)


def test_of_an_unbounded_scene_what_is_far_is_left_out(of_distance):
    space = ContractedSpace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))

    def two_balls(points):
        # In the shell, x = −1.4 is the world's −1 / (2 − 1.4), and 1.8 its 5.
        near = (points - torch.tensor([-1.25, 0, 0])).norm(dim=1) - 0.15
        return torch.minimum(near, (points - torch.tensor([1.9, 0, 0])).norm(dim=1) - 0.1)

    model = of_distance(two_balls, space.box, 61, space=space)
    middle = Cameras.looking_at(
        torch.zeros(1, 3), torch.tensor([[-1.0, 0, 0]]), focal=20.0, width=40, height=40
    )
    both, near = (
        space.to_world(exported(model, middle, pieces=0.0, reach=reach).points)
        for reach in (1e9, 2.0)
    )
    assert both[:, 0].max() > 20
    assert near[:, 0].min() == pytest.approx(-1 / 0.6, abs=0.02)
    assert near[:, 0].max() < 0


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"threshold": 1.0}, "export.threshold: "),
        ({"metres": 0.0}, "export.metres: "),
        ({"times": [0.5, 0.2]}, "export.times: expected ascending"),
        ({"times": [0.0, 1.2]}, "export.times: expected ascending"),
        ({"times": [0.0, 1.0], "fps": 3.0}, "export.times: "),
    ],
)
def test_settings_that_make_no_sense(settings, expected):
    with pytest.raises(DevrfError, match=expected):
        ExportSettings(**settings)


def test_a_threshold_that_nothing_crosses_is_refused(of_distance, cube, around):
    flat = of_distance(lambda points: 0.01 * points[:, 0], cube, 9)
    for threshold in (0.999, 1e-9):
        with pytest.raises(DevrfError, match=r"^export\.threshold: "):
            exported(flat, around, threshold=threshold)
