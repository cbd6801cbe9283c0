"""What all methods that deform a radiance field share."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.engine.batches import gather_batch
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


@pytest.fixture
def batch(tiny_scene: Scene) -> RayBatch:
    """Some rays of each moving image."""
    views = tiny_scene.dynamic.train
    image = torch.arange(len(views)).repeat_interleave(30)
    flat = torch.arange(len(image)) * 7 % (views.width * views.height)
    return gather_batch(views, image, flat, torch.ones(3))


def test_the_field_alone_learns_in_bfloat16_if_asked_to(tiny_scene: Scene, batch: RayBatch) -> None:
    exact = learner(SMALL, tiny_scene)(batch)
    model = learner(replace(SMALL, precision="bfloat16"), tiny_scene)
    seen = model(batch)
    assert seen.color.dtype == torch.float32
    assert torch.equal(seen.extras["points"], exact.extras["points"])
    torch.testing.assert_close(seen.color, exact.color, atol=0.02, rtol=0)
    assert not torch.equal(seen.color, exact.color)
    model.loss_terms(seen, batch, ["color", "elastic"])["color"].backward()
    for parameter in model.canonical.parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all()
    # What was learned is shown in all its digits.
    shown = model.eval()(batch), learner(SMALL, tiny_scene).eval()(batch)
    assert torch.equal(shown[0].color, shown[1].color)


def test_without_hulls_all_of_the_box_is_sampled(tiny_scene: Scene, batch: RayBatch) -> None:
    with_hull = learner(SMALL, tiny_scene)(batch)
    without = learner(replace(SMALL, hull=False), tiny_scene)
    assert without.occupancy.mask.all()
    assert len(without(batch).extras["weight"]) > len(with_hull.extras["weight"])


@pytest.mark.parametrize("separate", [False, True])
def test_coarse_colors_count_where_coarse_samples_have_a_field_of_their_own(
    separate: bool, tiny_scene: Scene, batch: RayBatch
) -> None:
    settings = replace(SMALL, sampling="hierarchical", separate_coarse=separate)
    model = learner(settings, tiny_scene)
    seen = model(batch)
    fine = (seen.color - batch.color).square().mean()
    found = model.loss_terms(seen, batch, ["color"])["color"]
    if not separate:
        torch.testing.assert_close(found, fine)
        return
    coarse = (seen.extras["coarse_color"] - batch.color).square().mean()
    torch.testing.assert_close(found, fine + coarse)
    assert len(seen.extras["coarse_weight"]) == 6 * len(batch.time)
    assert len(seen.extras["weight"]) == 12 * len(batch.time)


def test_views_in_half_precision_show_nearly_the_same(tiny_scene: Scene, batch: RayBatch) -> None:
    model = learner(SMALL, tiny_scene).eval()
    exact = model(batch).color
    with torch.autocast("cpu", torch.bfloat16), torch.no_grad():
        torch.testing.assert_close(model(batch).color, exact, atol=0.03, rtol=0)
