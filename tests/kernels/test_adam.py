"""A step of Adam by a kernel, and the gradient of the total variation, against their definition."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.kernels.adam import adam_step, add_total_variation_gradient
from devrf.ops import adam as definition
from devrf.ops.adam import AdamRule

SHAPE = (5, 4, 3)


def state(rng: torch.Generator, *shape: int) -> list[Tensor]:
    """Values, a gradient a third of whose numbers are zero, and moments."""
    values, gradient, mean, square = (torch.randn(*shape, generator=rng) for _ in range(4))
    gradient *= torch.rand(*shape, generator=rng) > 1 / 3
    return [values, gradient, mean, square.abs()]


def both(
    tensors: list[Tensor], rule: AdamRule, **options: Any
) -> tuple[list[Tensor], list[Tensor]]:
    """The tensors after a step by the kernel, and by the definition in double precision."""
    ours, theirs = [t.clone() for t in tensors], [t.double() for t in tensors]
    adam_step(*ours, rule, **options)
    definition.adam_step(*theirs, rule)
    return ours, theirs


@pytest.mark.parametrize(
    "shape", [(7,), (8, 3), (*SHAPE, 1), (*SHAPE, 3), (*SHAPE, 9), (*SHAPE, 12)]
)
@pytest.mark.parametrize("skip_zero", [False, True])
def test_a_step_is_that_of_the_definition(
    shape: tuple[int, ...], skip_zero: bool, rng: torch.Generator
) -> None:
    tensors = state(rng, *shape)
    rule = AdamRule(0.1, 3, betas=(0.8, 0.95), eps=1e-3, skip_zero=skip_zero)
    ours, theirs = both(tensors, rule)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one.double(), other, atol=1e-5, rtol=1e-5)
    assert not ours[1].any()
    still = tensors[1] == 0
    assert still.any() and not still.all()
    for k in (0, 2, 3):
        assert torch.equal(ours[k][still], tensors[k][still]) == skip_zero
        assert (ours[k][~still] != tensors[k][~still]).all()


@pytest.mark.parametrize("channels", [1, 3, 12])
@pytest.mark.parametrize("skip_zero", [False, True])
def test_each_voxel_has_its_rate(channels: int, skip_zero: bool, rng: torch.Generator) -> None:
    rates = torch.rand(*SHAPE, 1, generator=rng)
    rates[0] = 0
    rule = AdamRule(0.1, 2, skip_zero=skip_zero, per_voxel_lr=rates)
    tensors = state(rng, *SHAPE, channels)
    ours, theirs = both(tensors, rule)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one.double(), other, atol=1e-5, rtol=1e-5)
    assert torch.equal(ours[0][0], tensors[0][0]) and not torch.equal(ours[0][1], tensors[0][1])


@pytest.mark.parametrize("channels", [1, 3, 12])
@pytest.mark.parametrize("per_voxel", [False, True])
def test_outside_the_rows_nothing_is_read_or_written(
    channels: int, per_voxel: bool, rng: torch.Generator
) -> None:
    rows = torch.tensor([0, 7, 8, 31, 59], dtype=torch.int32)
    inside = torch.zeros(60, 1, dtype=torch.bool).index_fill_(0, rows.long(), True).view(*SHAPE, 1)
    tensors = state(rng, *SHAPE, channels)
    rates = torch.rand(*SHAPE, 1, generator=rng) if per_voxel else None
    rule = AdamRule(0.1, 4, skip_zero=True, per_voxel_lr=rates)
    # What is there is not zero, as it would be: that it stays shows that it is not looked at.
    ours, theirs = both(tensors, rule, rows=rows)
    outside = ~inside.expand(*SHAPE, channels)
    for one, other, before in zip(ours, theirs, tensors, strict=True):
        torch.testing.assert_close(one[~outside].double(), other[~outside], atol=1e-5, rtol=1e-5)
        assert torch.equal(one[outside], before[outside])
    assert not torch.equal(ours[0], tensors[0])


def test_no_rows_and_no_numbers_are_no_step(rng: torch.Generator) -> None:
    tensors = state(rng, *SHAPE, 3)
    rule = AdamRule(0.1, 1, skip_zero=True)
    ours, _ = both(tensors, rule, rows=torch.empty(0, dtype=torch.int32))
    assert all(torch.equal(one, before) for one, before in zip(ours, tensors, strict=True))
    empty = [torch.empty(0) for _ in range(4)]
    adam_step(*empty, rule)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("touched_only", [False, True])
def test_the_gradient_of_the_total_variation(
    channels: int, touched_only: bool, rng: torch.Generator
) -> None:
    # Differences on both sides of the bound, where the penalty changes.
    grid = 1.5 * torch.randn(*SHAPE, channels, generator=rng)
    gradient = state(rng, *SHAPE, channels)[1]
    ours, theirs = gradient.clone(), gradient.double()
    options = {"along_z": 0.3, "bound": 0.8, "touched_only": touched_only}
    add_total_variation_gradient(grid, ours, 0.7, **options)
    definition.add_total_variation_gradient(grid.double(), theirs, 0.7, **options)
    torch.testing.assert_close(ours.double(), theirs, atol=1e-5, rtol=0)
    untouched = gradient == 0
    assert untouched.any() and bool(ours[untouched].any()) != touched_only
    assert not torch.equal(ours[~untouched], gradient[~untouched])


def test_the_gradient_of_the_total_variation_of_the_smallest_grid() -> None:
    grid, gradient = torch.zeros(2, 2, 2, 1), torch.zeros(2, 2, 2, 1)
    grid[1, 1, 1] = 5.0
    add_total_variation_gradient(grid, gradient, 0.5, along_z=3.0)
    # 1 of each of three neighbours, of the one along z three times.
    expected = torch.zeros(2, 2, 2, 1)
    expected[1, 1, 1], expected[0, 1, 1], expected[1, 0, 1], expected[1, 1, 0] = (
        2.5,
        -0.5,
        -0.5,
        -1.5,
    )
    torch.testing.assert_close(gradient, expected)
