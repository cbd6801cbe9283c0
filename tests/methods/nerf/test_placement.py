"""Normalised space and its maps: by hand."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD
from devrf.methods.nerf.placement import Placement

CUBE = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def test_ndc_becomes_euclidean_by_hand() -> None:
    # z = 2 / (z_n − 1), x = −x_n z W / 2f, y = −y_n z H / 2f, in units of the near plane.
    ndc = Placement(CUBE, NormalizedDevice(width=40, height=30, focal=(50.0, 50.0), near=2.0))
    point = torch.tensor([0.5, -0.25, 0.5])
    z = 2 / (0.5 - 1)
    expected = torch.tensor([-0.5 * z * 40 / 100, 0.25 * z * 30 / 100, z])
    torch.testing.assert_close(ndc.euclidean(point), expected)


def test_the_near_limit_is_as_far_as_the_foremost_camera_leaves_it() -> None:
    ndc = Placement(CUBE, NormalizedDevice(width=40, height=20, focal=(20.0, 20.0), near=3.0))
    # Cameras look along −z; the near plane is at z = −3.
    assert ndc.near(0.0, torch.tensor([[0.0, 0.0, 1.0], [5.0, 0.0, -0.5]])) == pytest.approx(2.5)
    assert ndc.near(0.0, torch.tensor([[0.0, 0.0, -4.0]])) == pytest.approx(0.3)
    assert Placement(CUBE, WORLD).near(0.2, torch.zeros(1, 3)) == 0.2
    assert Placement(CUBE, WORLD).near(0.0, torch.zeros(1, 3)) == pytest.approx(1e-3)


def test_what_a_flow_leads_beyond_infinity_stays_before_it() -> None:
    ndc = Placement(CUBE, NormalizedDevice(40, 30, (50.0, 50.0), 1.0))
    z = ndc.euclidean(torch.tensor([[0.0, 0.0, 1.5], [0.0, 0.0, 0.99]]))[:, 2]
    torch.testing.assert_close(z, torch.full((2,), -200.0), rtol=1e-3, atol=0)


def test_a_box_becomes_normalised_by_its_longest_edge() -> None:
    place = Placement(Box((0.0, 0.0, 0.0), (8.0, 4.0, 2.0)), WORLD)
    corner = torch.tensor([[8.0, 4.0, 2.0]])
    assert place.normalised(corner).tolist() == [[1.0, 0.5, 0.25]]
    torch.testing.assert_close(place.fields(place.normalised(corner)), corner)
    # Distances in Euclidean space are those in normalised space.
    torch.testing.assert_close(place.euclidean(torch.ones(3)) - place.euclidean(torch.zeros(3)),
                               torch.ones(3))  # fmt: skip


@pytest.mark.parametrize(("depth", "kept"), [(0.94, True), (0.96, False)])
def test_the_nearest_share_of_ndc_is_held_smooth(depth: float, kept: bool) -> None:
    place = Placement(CUBE, NormalizedDevice(40, 30, (50.0, 50.0), 1.0))
    assert bool(place.within(torch.tensor([[0.0, 0.0, 2 * depth - 1]]), 0.95)) == kept


def test_elsewhere_what_cameras_look_at_is_held_smooth() -> None:
    room = ContractedSpace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    place = Placement(room.box, room)
    points = place.normalised(torch.tensor([[0.9, 0.0, 0.0], [1.1, 0.0, 0.0]]))
    assert place.within(points, 0.95).tolist() == [True, False]
