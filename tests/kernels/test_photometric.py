"""The photometric terms by the kernel, and their gradients, against the definitions."""

from __future__ import annotations

import pytest
import torch

from devrf.kernels.photometric import photometric
from devrf.ops.compositing import composite_colors
from devrf.ops.photometric import (
    alpha_mask_error,
    background_entropy,
    color_error,
    per_sample_color,
)
from random_samples import samples_of

WEIGHTS = {"render": 1.0, "per_sample_color": 0.3, "entropy": 0.2, "alpha_mask": 0.7}


@pytest.mark.parametrize("per_pixel", [1, 4])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("names", [["render"], ["alpha_mask", "entropy"], list(WEIGHTS)])
def test_terms_and_gradients_are_those_of_the_definitions(
    names: list[str], masked: bool, per_pixel: int, rng: torch.Generator
) -> None:
    ray = torch.randint(2, 290, (4000,), generator=rng).sort().values
    samples = samples_of(ray, 300, rng)
    samples.transmittance[:4] = torch.tensor([0.0, 1.0, 1e-7, 0.5])
    background = torch.rand(300, 3, generator=rng)
    truth = torch.rand(300 // per_pixel, 3, generator=rng).repeat_interleave(per_pixel, dim=0)
    color = torch.rand(len(ray), 3, generator=rng)
    alpha = torch.rand(300 // per_pixel, generator=rng).repeat_interleave(per_pixel)
    alpha = alpha if masked else None
    end = samples.transmittance
    learned = [samples.weight, color, end, background]
    for tensor in learned:
        tensor.requires_grad_()
    image = composite_colors(samples.weight, color, ray, end, background)
    weights = {name: WEIGHTS[name] for name in names}
    total, values = photometric(samples, color, background, image, truth, alpha, weights, per_pixel)
    terms = {
        "render": color_error(image, truth, per_pixel),
        "per_sample_color": per_sample_color(samples.weight, color, ray, truth),
        "entropy": background_entropy(end),
        "alpha_mask": alpha_mask_error(end, alpha, per_pixel),
    }
    expected = sum(weights[name] * terms[name] for name in names)
    assert list(values) == [*names, "opacity", *(["coverage"] if masked else [])]
    for name in names:
        torch.testing.assert_close(values[name], terms[name].detach())
    torch.testing.assert_close(values["opacity"], 1 - end.detach().mean())
    torch.testing.assert_close(total, expected)
    ours = torch.autograd.grad(2 * total, learned, allow_unused=True, materialize_grads=True)
    theirs = torch.autograd.grad(2 * expected, learned, allow_unused=True, materialize_grads=True)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, atol=1e-7, rtol=2e-5)
