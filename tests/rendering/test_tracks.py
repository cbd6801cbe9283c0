"""Points are followed through time by what a method knows of motion."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from devrf.geometry.box import Box
from devrf.geometry.space import WORLD
from devrf.methods.dnerf.model import DNeRF, DNeRFSettings
from devrf.methods.tineuvox.model import TiNeuVox
from devrf.methods.tineuvox.settings import TiNeuVoxSettings
from devrf.ops.splatting import Gaussians
from devrf.rendering.tracks import track


def stub(**maps):
    nothing = {"gaussians_at": lambda _: None, "forward_warp": lambda _: None}
    return SimpleNamespace(space=WORLD, **{**nothing, "backward_warp": lambda _: None, **maps})


def test_points_are_followed_by_a_map_back_and_by_the_nearest_gaussian():
    points = torch.tensor([[1.0, 0, 0], [0, 2, 0]])
    back = stub(backward_warp=lambda time: lambda x: x * (1 - 0.4 * time))
    places = track(back, points, 0.5, [1.0, 0.0])
    torch.testing.assert_close(places, torch.stack([points * 0.8 / 0.6, points * 0.8]))
    half = math.sqrt(0.5)

    def turned(time: float) -> Gaussians:
        about_z = torch.tensor([[1.0, 0, 0, 0], [half, 0, 0, half] if time else [1.0, 0, 0, 0]])
        means = torch.tensor([[9.0, 9, 9], [1, 1, 0]]) + time
        return Gaussians(means, torch.ones(2, 3), about_z, torch.ones(2), torch.ones(2, 3))

    # One to the right of the middle comes to lie above it.
    places = track(stub(gaussians_at=turned), torch.tensor([[2.0, 1, 0]]), 0.0, [1.0])
    torch.testing.assert_close(places, torch.tensor([[[2.0, 3, 1]]]))
    assert track(stub(), points, 0.0, [1.0]) is None


@pytest.mark.parametrize("kind", [DNeRF, TiNeuVox])
@torch.no_grad()
def test_networks_that_know_the_way_back(kind):
    small = {DNeRF: DNeRFSettings(deformation_width=8), TiNeuVox: TiNeuVoxSettings(side=16)}
    model = kind(small[kind])
    model.set_place(Box((0.0, 0.0, 0.0), (4.0, 2.0, 2.0)), WORLD, (0.0, 9.0))
    layers = [layer for layer in model.deformation.modules() if isinstance(layer, nn.Linear)]
    nn.init.zeros_(layers[-1].weight)
    layers[-1].bias.copy_(torch.tensor([0.1, 0, 0]))  # 0.2 where the box's longest edge is 4
    points = torch.rand(5, 3)
    back = model.backward_warp(0.5)(points)
    torch.testing.assert_close(back, points + torch.tensor([0.2, 0, 0]))
    there = points + torch.tensor([0.2 if kind is DNeRF else 0.0, 0, 0])  # its time 0 is at rest
    torch.testing.assert_close(track(model, points, 0.5, [0.0, 0.5]), torch.stack([there, points]))
