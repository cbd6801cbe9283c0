"""What all methods that deform a radiance field share."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.methods.hypernerf.model import HyperNeRF, HyperNeRFSettings
from devrf.scenes.scene import Scene

SMALL = HyperNeRFSettings(
    width=16, depth=3, bands=3, direction_bands=1, sampling="occupancy", separate_coarse=False,
    steps=16, occupancy_side=12, coarse=6, fine=6, code=3, warp_width=8, warp_depth=2,
    slicing_width=8, slicing_depth=2,
)  # fmt: skip


def learner(settings: HyperNeRFSettings, scene: Scene) -> HyperNeRF:
    """A model with the same first weights and frames every time."""
    torch.manual_seed(0)
    model = HyperNeRF(settings)
    model.setup(scene)
    torch.manual_seed(1)
    return model


def test_without_hulls_all_of_the_box_is_sampled(tiny_scene: Scene, some_rays: RayBatch) -> None:
    without = learner(replace(SMALL, hull=False), tiny_scene)
    assert without.occupancy.mask.all()
    with_hull = learner(SMALL, tiny_scene)(some_rays).extras["weight"]
    assert len(without(some_rays).extras["weight"]) > len(with_hull)


@pytest.mark.parametrize("separate", [False, True])
def test_coarse_colors_count_where_coarse_samples_have_a_field_of_their_own(
    separate: bool, tiny_scene: Scene, some_rays: RayBatch
) -> None:
    settings = replace(SMALL, sampling="hierarchical", separate_coarse=separate)
    model = learner(settings, tiny_scene)
    output = model(some_rays)
    fine = (output.color - some_rays.color).square().mean()
    loss = model.loss_terms(output, some_rays, ["render"])["render"]
    assert len(output.extras["weight"]) == 12 * len(some_rays.time)
    if not separate:
        torch.testing.assert_close(loss, fine)
        return
    coarse = (output.extras["coarse_color"] - some_rays.color).square().mean()
    torch.testing.assert_close(loss, fine + coarse)
    assert len(output.extras["coarse_weight"]) == 6 * len(some_rays.time)
    loss.backward()
    assert model.coarse is not None and model.coarse.color.output.weight.grad.abs().max() > 0
