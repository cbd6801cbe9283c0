"""The photometric terms on four samples of three rays, by hand; and their composer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.errors import DevrfError
from devrf.geometry.rays import Rays
from devrf.methods.devrf.losses import (
    PHOTOMETRIC_TERMS,
    Prediction,
)
from devrf.methods.devrf.weighted_loss import weighted_loss
from devrf.methods.weighted_loss import counted_weights
from devrf.rendering.output import VoxelOutput
from devrf.rendering.sampling import Samples

RAY = torch.tensor([0, 0, 2])


@pytest.fixture
def prediction(ray_batch: Callable[..., RayBatch]) -> Prediction:
    """Rays 0 and 2 see two samples and one, ray 1 sees none."""
    weight = torch.tensor([0.5, 0.25, 0.8], requires_grad=True)
    sample_color = torch.tensor(
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, 0.5]], requires_grad=True
    )
    output = VoxelOutput(
        color=torch.tensor([[0.5, 0.25, 0.0], [0.0, 0.0, 0.0], [0.4, 0.4, 0.4]]),
        depth=torch.zeros(3),
        transmittance=torch.tensor([0.25, 1.0, 0.2]),
        samples=Samples(RAY, torch.ones(3), torch.zeros(3, 3), 3),
        canonical=torch.zeros(3, 3),
        weight=weight,
        sample_color=sample_color,
    )
    batch = ray_batch(
        Rays(*[torch.zeros(3, 3)] * 3),
        color=torch.tensor([[1.0, 0.25, 0.0], [0.0, 0.0, 0.6], [0.4, 0.4, 0.1]]),
        alpha=torch.tensor([1.0, 0.0, 0.5]),
    )
    return Prediction(output, batch)


def test_color_is_the_mean_square_over_rays_and_channels(prediction: Prediction) -> None:
    assert PHOTOMETRIC_TERMS["color"](prediction).item() == pytest.approx((0.25 + 0.36 + 0.09) / 9)


def test_per_sample_color_by_hand(prediction: Prediction) -> None:
    # |c − C|²: (0, .25, 0)² = .0625; (1, .75, 0)² = 1.5625; (.1, .1, .4)² = .18; three rays.
    expected = (0.5 * 0.0625 + 0.25 * 1.5625 + 0.8 * 0.18) / 3
    assert PHOTOMETRIC_TERMS["per_sample_color"](prediction).item() == pytest.approx(expected)


def test_per_sample_color_stops_at_the_weights(prediction: Prediction) -> None:
    PHOTOMETRIC_TERMS["per_sample_color"](prediction).backward()
    assert prediction.output.weight.grad is None
    # 2 · w · (c − C) / R of the first sample's green.
    assert prediction.output.sample_color.grad is not None
    assert prediction.output.sample_color.grad[0, 1].item() == pytest.approx(2 * 0.5 * -0.25 / 3)


def test_entropy_by_hand(prediction: Prediction) -> None:
    def entropy(p: float) -> float:
        return -(p * math.log(p) + (1 - p) * math.log(1 - p))

    expected = (entropy(0.25) + 0 + entropy(0.2)) / 3
    assert PHOTOMETRIC_TERMS["entropy"](prediction).item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("p", [0.0, 1.0])
def test_entropy_has_finite_gradients_at_its_ends(prediction: Prediction, p: float) -> None:
    end = torch.full((3,), p, requires_grad=True)
    output = replace(prediction.output, transmittance=end)
    PHOTOMETRIC_TERMS["entropy"](replace(prediction, output=output)).backward()
    assert end.grad is not None and end.grad.isfinite().all()


def test_alpha_mask_by_hand_and_without_one(prediction: Prediction) -> None:
    # T − (1 − alpha) = 0.25, 0, −0.3.
    assert PHOTOMETRIC_TERMS["alpha_mask"](prediction).item() == pytest.approx((0.0625 + 0.09) / 3)
    without = replace(prediction, batch=replace(prediction.batch, alpha=None))
    assert PHOTOMETRIC_TERMS["alpha_mask"](without).item() == 0


def test_the_loss_weighs_what_counts_and_reports_it_unweighted(prediction: Prediction) -> None:
    weights = counted_weights({"alpha_mask": 2.0, "color": 0.0}, PHOTOMETRIC_TERMS, "loss.fine")
    total, values = weighted_loss(prediction, PHOTOMETRIC_TERMS, weights)
    assert (
        list(values) == ["alpha_mask", "opacity", "coverage"] and total == 2 * values["alpha_mask"]
    )
    # 1 − (0.25 + 1 + 0.2) / 3, and (1 + 0 + 0.5) / 3.
    assert values["opacity"].item() == pytest.approx(1.55 / 3)
    assert values["coverage"].item() == pytest.approx(0.5)
    without = replace(prediction, batch=replace(prediction.batch, alpha=None))
    assert weighted_loss(without, PHOTOMETRIC_TERMS, weights)[1].keys() == {"alpha_mask", "opacity"}


@pytest.mark.parametrize(
    ("weights", "told"),
    [
        (
            {"colour": 1.0},
            r"loss.fine: unknown term 'colour'.*alpha_mask, color, entropy",
        ),
        ({"color": 0.0}, "loss.fine: every weight is zero"),
    ],
)
def test_wrong_weights_are_told(weights: dict[str, float], told: str) -> None:
    with pytest.raises(DevrfError, match=told):
        counted_weights(weights, PHOTOMETRIC_TERMS, "loss.fine")
