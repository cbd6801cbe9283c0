"""A list's significant samples, in both implementations and by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from devrf.ops.dispatch import Kind, using
from devrf.ops.search import PackedSamples
from devrf.ops.selection import select_listed

Draw = Callable[..., Tensor]
Both = Callable[[Callable[[], Sequence[Tensor]]], None]


def listed(draw: Draw, flags: Tensor, first: Tensor) -> PackedSamples:
    """Samples of rays that begin at ``first``."""
    places, device = len(flags), draw(1).device
    return PackedSamples(
        torch.searchsorted(first[1:].contiguous(), torch.arange(places), right=True).to(device),
        draw(places),
        draw(places, 3),
        flags.to(device),
        first.to(device),
        first[-1].to(device),
        first.diff().to(device),
        places,
    )


@pytest.mark.parametrize("kernels", ["torch", "triton"])
def test_by_hand(draw: Draw, device: torch.device, kernels: Kind) -> None:
    flags = torch.tensor([True, False, True, True, False, True, False, False])
    found = listed(draw, flags, torch.tensor([0, 2, 2, 4, 6]))
    canonical = torch.arange(24.0).view(8, 3).to(device).requires_grad_()
    weight = torch.arange(1.0, 9.0).to(device).requires_grad_()
    with using(kernels):
        chosen = select_listed(found, canonical, weight, 6)
        up = torch.arange(10.0, 16.0).to(device)
        ((chosen.canonical * up[:, None]).sum() + (chosen.weight * up).sum()).backward()
    assert chosen.first.tolist() == [0, 1, 1, 3, 4] and chosen.total == 4
    assert chosen.present.tolist() == [True] * 4 + [False] * 2
    # Padding has any ray, but different ones.
    assert chosen.ray.tolist() == [0, 2, 2, 3, 0, 1]
    assert chosen.weight.tolist() == [1, 3, 4, 6, 0, 0]
    assert chosen.canonical[:4, 0].tolist() == [0, 6, 9, 15]
    assert torch.equal(chosen.points[:4], found.points[[0, 2, 3, 5]])
    assert torch.equal(chosen.distance[:4], found.distance[[0, 2, 3, 5]])
    assert weight.grad is not None and canonical.grad is not None
    assert weight.grad.tolist() == [10, 0, 11, 12, 0, 13, 0, 0]
    assert torch.equal(canonical.grad, weight.grad[:, None].expand(8, 3))


@pytest.mark.parametrize("capacity", [0, 70, 900, 1500])
@pytest.mark.parametrize("moves", [True, False])
def test_a_list_of_several_programs(draw: Draw, agree: Both, capacity: int, moves: bool) -> None:
    flags = draw(1500).cpu() > 0.2
    flags[1400:] = False
    found = listed(draw, flags, torch.tensor([0, 0, 300, 1000, 1400]))
    canonical, weight = draw(1500, 3).requires_grad_(moves), draw(1500).requires_grad_()
    upstream = draw(capacity, 3), draw(capacity)

    def work() -> Sequence[Tensor]:
        chosen = select_listed(found, canonical, weight, capacity)
        assert chosen.canonical.requires_grad == moves
        loss = (chosen.weight * upstream[1]).sum()
        if moves:
            loss = loss + (chosen.canonical * upstream[0]).sum()
        leaves = (weight, canonical) if moves else (weight,)
        return *chosen, *torch.autograd.grad(loss, leaves)

    agree(work)


def test_a_list_that_is_too_short_to_choose_from(draw: Draw, device: torch.device) -> None:
    found = listed(draw, torch.ones(5, dtype=torch.bool), torch.tensor([0, 2, 5]))
    with using("triton"), pytest.raises(ValueError, match="6 of 5"):
        select_listed(found, draw(5, 3), draw(5), 6)
