"""Colours of rays by the kernel, and their gradients, against the definition."""

from __future__ import annotations

import pytest
import torch

from devrf.kernels.compositing import composite_colors
from devrf.ops import compositing as definition
from random_samples import samples_of


@pytest.mark.parametrize("background", [(3,), (300, 3)])
def test_colors_and_gradients_are_those_of_the_definition(
    background: tuple[int, ...], rng: torch.Generator
) -> None:
    ray = torch.randint(2, 290, (4000,), generator=rng).sort().values
    samples = samples_of(ray, 300, rng)
    color = torch.rand(len(ray), 3, generator=rng)
    behind = torch.rand(background, generator=rng)
    given = torch.randn(300, 3, generator=rng)
    learned = [samples.weight, color, samples.transmittance]
    learned += [behind] if len(background) == 2 else []
    for tensor in learned:
        tensor.requires_grad_()
    ours = composite_colors(samples, color, behind)
    theirs = definition.composite_colors(samples.weight, color, ray, samples.transmittance, behind)
    torch.testing.assert_close(ours, theirs)
    of_ours = torch.autograd.grad((ours * given).sum(), learned)
    of_theirs = torch.autograd.grad((theirs * given).sum(), learned)
    torch.testing.assert_close(of_ours, of_theirs)


def test_without_samples_a_ray_shows_the_background(rng: torch.Generator) -> None:
    samples = samples_of(torch.zeros(0, dtype=torch.long), 3, rng)
    image = composite_colors(samples, torch.zeros(0, 3), torch.tensor([1.0, 0.5, 0.0]))
    expected = samples.transmittance[:, None] * torch.tensor([1.0, 0.5, 0.0])
    torch.testing.assert_close(image, expected)
