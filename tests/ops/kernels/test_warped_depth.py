"""The kernels of warp and density against their PyTorch twin."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.ops.warped_depth import warped_depth

Draw = Callable[..., Tensor]
Both = Callable[[Callable[[], tuple[Tensor, ...]]], None]

BOX = Box((-1.0, -0.8, -0.9), (0.9, 1.0, 0.7))


@pytest.mark.parametrize("frames", [0, 1, 2])
@pytest.mark.parametrize("points", [0, 1, 133])
def test_values_and_gradients(draw: Draw, agree: Both, frames: int, points: int) -> None:
    # Some points start outside the box, others are sent there.
    x, raw = 1.2 * draw(points, 3), 3 * draw(4, 3, 5, 1)
    slices = [0.4 * draw(3, 4, 3, 3) for _ in range(frames)]
    to_q, to_tau = draw(points, 3), draw(points)

    def work() -> tuple[Tensor, ...]:
        leaves = [grid.clone().requires_grad_() for grid in (raw, *slices)]
        q, tau = warped_depth(x, leaves[0], leaves[1:], 0.3, box=BOX, shift=-1.0, delta=0.5)
        loss = (q * to_q).sum() + (tau * to_tau).sum()
        return q.detach(), tau.detach(), *torch.autograd.grad(loss, leaves)

    agree(work)


@pytest.mark.parametrize("trained", [0, 1, 2])
def test_one_grid_is_trained_and_the_others_are_frozen(
    draw: Draw, agree: Both, trained: int
) -> None:
    x, grids = draw(40, 3), [draw(4, 3, 5, 1), draw(3, 3, 3, 3), draw(3, 3, 3, 3)]

    def work() -> tuple[Tensor, ...]:
        leaves = [grid.clone().requires_grad_(n == trained) for n, grid in enumerate(grids)]
        q, tau = warped_depth(x, leaves[0], leaves[1:], 0.7, box=BOX, shift=-1.0, delta=0.5)
        (tau.sum() + q.square().sum()).backward()
        found = leaves[trained].grad
        assert found is not None
        assert all(leaf.grad is None for n, leaf in enumerate(leaves) if n != trained)
        return (found,)

    agree(work)


def test_gradients_may_be_added_to_buffers(draw: Draw, agree: Both) -> None:
    x, raw, frame = draw(40, 3), draw(3, 3, 3, 1), draw(3, 4, 3, 3)
    buffers = (draw(3, 3, 3, 1), draw(3, 4, 3, 3))

    def work() -> tuple[Tensor, ...]:
        into = [buffer.clone() for buffer in buffers]
        leaves = [raw.clone().requires_grad_(), frame.clone().requires_grad_()]
        q, tau = warped_depth(
            x,
            leaves[0],
            leaves[1:],
            box=BOX,
            shift=-1.0,
            delta=0.5,
            density_gradient=into[0],
            slice_gradients=into[1:],
        )
        (tau.sum() + q.square().sum()).backward()
        assert all(leaf.grad is None for leaf in leaves)
        return tuple(into)

    agree(work)


@pytest.mark.parametrize("shift", [-16.0, -4.6, 0.0, 30.0])
def test_faint_and_dense_keep_their_digits(draw: Draw, agree: Both, shift: float) -> None:
    # log(1 + exp(x)) of x about −16 is 1e-7: a plain sum with 1 would lose it.
    x, raw = draw(60, 3), 2 * draw(3, 3, 3, 1)

    def work() -> tuple[Tensor, ...]:
        leaf = raw.clone().requires_grad_()
        _, tau = warped_depth(x, leaf, box=BOX, shift=shift, delta=0.5)
        tau.log().sum().backward()
        assert leaf.grad is not None
        return tau.detach().log(), leaf.grad

    agree(work)
