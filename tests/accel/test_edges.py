"""Kernels against their twins at the edges: nothing, faint, kept, frozen, too long."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.ops.check import BOX
from devrf.ops.color_network import ColorNetwork, listed_colors
from devrf.ops.compositing import composite, composite_segments
from devrf.ops.dispatch import using
from devrf.ops.search import Thresholds, find_samples
from devrf.ops.trilinear import interpolate
from devrf.ops.warped_depth import warped_depth

pytestmark = pytest.mark.gpu
Both = Callable[[Callable[[], Sequence[Tensor]]], None]


def test_nothing_gives_nothing_and_nowhere_a_value(draw, agree):
    grid, density, nothing = draw.leaf(4, 5, 3, 3), draw.leaf(4, 3, 5, 1), draw.leaf(0, 3)
    first = torch.zeros(3, dtype=torch.long, device=draw.device)

    def work() -> Sequence[Tensor]:
        values = interpolate(grid, nothing)
        moved, tau = warped_depth(nothing.detach(), density, box=BOX, shift=-1.0, delta=0.5)
        leaves, sums = (grid, nothing, density), (values.sum() + tau.sum())
        rest = composite_segments(nothing[:, 0].detach(), first)
        return values, moved, tau, *rest, *torch.autograd.grad(sums, leaves)

    agree(work)
    with using("triton"):
        nowhere = torch.full((1, 3), float("nan"), device=draw.device)
        assert interpolate(grid, nowhere).shape == (1, 3)


@pytest.mark.parametrize("shift", [-16.0, 30.0])
def test_faint_and_dense_keep_their_digits(draw, agree, shift):
    # log(1 + exp(x)) of x about −16 is 1e-7: a plain sum with 1 would lose it.
    x, raw = draw(60, 3), draw.leaf(3, 3, 3, 1)

    def work() -> Sequence[Tensor]:
        tau = warped_depth(x, 2 * raw, box=BOX, shift=shift, delta=0.5)[1].log()
        return tau.detach(), *torch.autograd.grad(tau.sum(), raw)

    agree(work)


def test_what_is_behind_an_opaque_sample(draw, agree):
    counts = torch.tensor([0, 3, 0, 33, 70, 0])
    first = torch.nn.functional.pad(counts.cumsum(0), (1, 0)).to(draw.device)
    # Optical depths from 1e-6 to 5, some as good as infinite; the last five are padding.
    depth = 5 * draw(111).abs() ** 8 + 1e-6
    depth[::25] = 300.0
    to_weights, to_end, leaf = draw(111), draw(6), depth.requires_grad_()
    ray = torch.repeat_interleave(counts).to(draw.device)

    def work() -> Sequence[Tensor]:
        weights, end = composite_segments(leaf, first)
        loss = (weights * to_weights).sum() + (end * to_end).sum()
        each = composite(leaf.detach()[: len(ray)], ray, 6)
        return *each, weights.detach(), end.detach(), *torch.autograd.grad(loss, leaf)

    agree(work)


@pytest.mark.parametrize(
    "changed", [{"rays": 0}, {"capacity": 0}, {"longest": 40}, {"stop": 1.0}], ids=str
)
def test_searches_that_end_early(draw, agree, changed):
    settings = {"rays": 6, "capacity": 200, "longest": 70, "stop": 0.01, **changed}
    rays = int(settings["rays"])
    directions = torch.nn.functional.normalize(draw(rays, 3), dim=1)
    count = torch.tensor([32, 0, 70, 1, 40, 0])[:rays].to(draw.device)
    along = 0.4 * draw(rays, 3), directions, -1 + 0.1 * draw(rays), count
    mask, density = draw(5, 4, 6) > -0.3, 3 * draw(4, 3, 5, 1)
    agree(
        lambda: astuple(
            find_samples(
                *(*along, mask, density),
                step=0.03,
                longest=int(settings["longest"]),
                capacity=int(settings["capacity"]),
                mask_box=BOX,
                box=BOX,
                shift=-1.0,
                delta=0.5,
                thresholds=Thresholds(alpha=0.05, stop=settings["stop"], weight=0.1),
            )
        )
    )


@pytest.mark.parametrize("frozen", [(3,), range(8)])
def test_colors_add_to_gradients_that_are_kept(draw, agree, frozen):
    """Of four rays, 100 samples, 30 places of padding, all that is not frozen."""
    width, places = 6, 130
    shapes = (width, 7), (width,), (width, 21), (width, width), (width,), (3, width)
    start = [draw(3, 4, 3, 7), *(draw(*shape) for shape in shapes), draw(3)]
    at, directions = draw(places, 3), draw(4, 3)
    ray = (torch.arange(places) % 4).to(draw.device)
    first = torch.tensor([0, 20, 20, 90, 100]).to(draw.device)
    octaves = 2.0 ** torch.arange(3, device=draw.device)

    def work() -> Sequence[Tensor]:
        points = at.clone().requires_grad_()
        leaves = [value.clone().requires_grad_(k not in frozen) for k, value in enumerate(start)]
        for leaf in leaves:
            leaf.grad = torch.ones_like(leaf) if leaf.requires_grad else None
        network = ColorNetwork(*[*leaves[1:], octaves])
        colors = listed_colors(leaves[0], points, BOX, directions, ray, first, network)
        assert colors.isfinite().all()
        colors[:100].sum().backward()
        learned = [leaf.grad for k, leaf in enumerate([*leaves, points]) if k not in frozen]
        assert all(leaves[k].grad is None for k in frozen)
        return [colors[:100].detach(), *(grad / 10 for grad in learned if grad is not None)]

    agree(work)


@pytest.mark.parametrize("frames", [0, 2])
def test_warped_depths_add_to_gradients_that_are_kept(draw, agree, frames):
    # Some points start outside the box, others are sent there.
    x, grids = 1.2 * draw(133, 3), [3 * draw(4, 3, 5, 1), *[0.4 * draw(3, 4, 3, 3)] * frames]
    to_q, to_tau = draw(133, 3), draw(133)

    def work() -> Sequence[Tensor]:
        leaves, into = [g.clone().requires_grad_() for g in grids], [g.clone() for g in grids]
        settings: dict[str, Any] = {"box": BOX, "shift": -1.0, "delta": 0.5}
        settings |= {"density_gradient": into[0], "slice_gradients": into[1:]}
        q, tau = warped_depth(x, leaves[0], leaves[1:], 0.3, **settings)
        ((q * to_q).sum() + (tau * to_tau).sum()).backward()
        assert all(leaf.grad is None for leaf in leaves)
        return [q.detach(), tau.detach(), *into]

    agree(work)
