"""Nerfies' facts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.errors import DevrfError
from devrf.methods.nerfies.model import Nerfies, NerfiesSettings
from devrf.scenes.scene import Scene

TINY = NerfiesSettings(
    width=8, depth=3, bands=2, direction_bands=1, sampling="occupancy", separate_coarse=False,
    steps=16, occupancy_side=8, coarse=8, fine=8, code=3, warp_width=8, warp_depth=3, warp_bands=4,
    warp_skip=2,
)  # fmt: skip


def test_the_warp_opens_over_its_share_of_a_stage() -> None:
    model = Nerfies(replace(TINY, window=0.5))
    opened = []
    for step in (0, 25, 50, 100):
        model.on_iteration(step, 100)
        opened.append(model.warp.opened.item())
    assert opened == [0.0, 2.0, 4.0, 4.0]


def test_motions_begin_next_to_none_at_any_time() -> None:
    model, points = Nerfies(TINY), torch.rand(9, 3)
    moved, beside = model.deform(points, torch.linspace(0, 1, 9))
    assert beside is None
    assert 0 < (moved - points).abs().amax() < 1e-2
    # Jointly it is free at time 0, too.
    assert not torch.equal(moved[0], points[0])


@pytest.mark.parametrize("elastic", ["drawn", "full"])
@pytest.mark.parametrize("separate", [True, False])
def test_a_warp_that_stretches_is_punished_and_one_that_turns_is_not(
    elastic: Any, separate: bool, tiny_scene: Scene, some_rays: RayBatch
) -> None:
    model = Nerfies(
        replace(TINY, elastic=elastic, sampling="hierarchical", separate_coarse=separate)
    )
    model.setup(tiny_scene)
    model.warp.opened.fill_(4)
    for head in (model.warp.rotation, model.warp.velocity):
        torch.nn.init.zeros_(head.weight)
    model.warp.rotation.bias.data = torch.tensor([1.0, -0.5, 2.0])  # one turn of all there is
    turned = model.loss_terms(model(some_rays), some_rays, ["elastic"])["elastic"]
    assert turned.item() < 1e-6
    torch.nn.init.normal_(model.warp.velocity.weight)
    stretched = model.loss_terms(model(some_rays), some_rays, ["elastic"])["elastic"]
    # c ρ is at most 2 c = 0.06, and the weights of a ray come to at most 1.
    assert 1e-3 < stretched.item() < 0.06


def test_what_cannot_be_is_said() -> None:
    with pytest.raises(DevrfError, match=r"settings\.separate_coarse: .*sampling=occupancy"):
        replace(TINY, separate_coarse=True)
    with pytest.raises(DevrfError, match=r"settings\.window: .* 1\.5"):
        replace(TINY, window=1.5)
    with pytest.raises(DevrfError, match=r"settings\.empty_from: .* 1\.5"):
        replace(TINY, empty_from=1.5)
