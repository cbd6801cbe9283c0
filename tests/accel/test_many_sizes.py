"""Kernels against their twins at many sizes and extremes: on a GPU, or with ``make fuzz``."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import astuple
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.ops.adam_step import AdamRule, adam_step, add_total_variation_gradient
from devrf.ops.check import Draw
from devrf.ops.color_network import ColorNetwork, listed_colors
from devrf.ops.compositing import composite, composite_segments
from devrf.ops.dispatch import using
from devrf.ops.search import Thresholds, find_samples, select_listed
from devrf.ops.trilinear import interpolate
from devrf.ops.warped_depth import warped_depth

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(
        not torch.cuda.is_available() and os.environ.get("DEVRF_ALL_LAUNCHES") != "1",
        reason="needs a GPU; make fuzz runs it in Triton's interpreter",
    ),
]
Both = Callable[[Callable[[], Sequence[Tensor]]], None]
BOX = Box((-1.0, -0.8, -0.9), (0.9, 1.0, 0.7))


@pytest.mark.parametrize(
    ("channels", "points"),
    # None, one, and some more than a block or two hold.
    [(1, 0), (1, 1), (1, 131), (3, 0), (3, 35), (9, 19), (12, 0), (12, 1), (12, 67)],
)
def test_interpolation(draw: Draw, agree: Both, channels: int, points: int) -> None:
    # About half of the points lie outside the grid, some on grid points, one is no number.
    grid, coords = draw.leaf(4, 5, 3, channels), (2 + 3.5 * draw(points, 3)).requires_grad_()
    upstream, on_points = draw(points, channels), coords.detach().round()
    agree(
        lambda: (
            interpolate(grid, on_points).detach(),
            *torch.autograd.grad(interpolate(grid, coords), (grid, coords), upstream),
        )
    )
    with using("triton"):
        nowhere = torch.full((1, 3), float("nan"), device=draw.device)
        assert interpolate(grid, nowhere).shape == (1, channels)


@pytest.mark.parametrize("buffers", [False, True])
@pytest.mark.parametrize("frames", [0, 1, 2])
@pytest.mark.parametrize("points", [0, 1, 133])
def test_warped_depth(draw: Draw, agree: Both, frames: int, points: int, buffers: bool) -> None:
    # Some points start outside the box, others are sent there.
    x, grids = 1.2 * draw(points, 3), [3 * draw(4, 3, 5, 1), *[0.4 * draw(3, 4, 3, 3)] * frames]
    to_q, to_tau, filled = draw(points, 3), draw(points), [torch.ones_like(g) for g in grids]

    def work() -> Sequence[Tensor]:
        leaves, into = [g.clone().requires_grad_() for g in grids], [b.clone() for b in filled]
        kept = {"density_gradient": into[0], "slice_gradients": into[1:]} if buffers else {}
        settings: dict[str, Any] = {"box": BOX, "shift": -1.0, "delta": 0.5, **kept}
        q, tau = warped_depth(x, leaves[0], leaves[1:], 0.3, **settings)
        loss = (q * to_q).sum() + (tau * to_tau).sum()
        loss.backward()
        grads = [into[k] if buffers else leaf.grad for k, leaf in enumerate(leaves)]
        return [q.detach(), tau.detach(), *(grad for grad in grads if grad is not None)]

    agree(work)


@pytest.mark.parametrize("shift", [-16.0, -4.6, 0.0, 30.0])
def test_faint_and_dense_keep_their_digits(draw: Draw, agree: Both, shift: float) -> None:
    # log(1 + exp(x)) of x about −16 is 1e-7: a plain sum with 1 would lose it.
    x, raw = draw(60, 3), draw.leaf(3, 3, 3, 1)

    def work() -> Sequence[Tensor]:
        tau = warped_depth(x, 2 * raw, box=BOX, shift=shift, delta=0.5)[1].log()
        return tau.detach(), *torch.autograd.grad(tau.sum(), raw)

    agree(work)


@pytest.mark.parametrize(
    "changed",
    [
        {"rays": 0},
        {"capacity": 0},
        {"capacity": 20},
        {"longest": 40},
        {"threshold": 2.0},
        {"stop": 0.0},
        {"stop": 1.0},
        {"frames": 0},
        {"frames": 2},
    ],
    ids=str,
)
def test_search(draw: Draw, agree: Both, changed: dict[str, Any]) -> None:
    """Rays of up to 70 samples: none to three rounds of lanes."""
    settings = {"rays": 6, "capacity": 200, "longest": 70, "threshold": -0.3, "stop": 0.01}
    settings |= {"frames": 1, **changed}
    rays = settings["rays"]
    directions = torch.nn.functional.normalize(draw(rays, 3), dim=1)
    count = torch.tensor([32, 0, 70, 1, 40, 0])[:rays].to(draw.device)
    along = 0.4 * draw(rays, 3), directions, -1 + 0.1 * draw(rays), count
    mask, density = draw(5, 4, 6) > settings["threshold"], 3 * draw(4, 3, 5, 1)
    slices = [0.2 * draw(3, 4, 3, 3) for _ in range(settings["frames"])]
    agree(
        lambda: astuple(
            find_samples(
                *(*along, mask, density, slices, 0.3),
                step=0.03,
                longest=settings["longest"],
                capacity=settings["capacity"],
                mask_box=Box((-0.7, -0.8, -0.9), (0.9, 0.9, 0.5)),
                box=BOX,
                shift=-1.0,
                delta=0.5,
                thresholds=Thresholds(alpha=0.05, stop=settings["stop"], weight=0.1),
            )
        )
    )


@pytest.mark.parametrize("capacity", [0, 70, 900, 1500])
@pytest.mark.parametrize("moves", [True, False])
def test_selection(draw: Draw, agree: Both, capacity: int, moves: bool) -> None:
    """A list of several programs, of which 100 places are padding."""
    count = torch.full((700,), 2, device=draw.device)
    directions = torch.nn.functional.normalize(draw(700, 3), dim=1)
    cube: dict[str, Any] = {"mask_box": BOX, "box": BOX, "shift": 3.0, "delta": 0.5}
    everywhere = torch.ones(2, 2, 2, dtype=torch.bool, device=draw.device)
    found = find_samples(
        *(0.1 * draw(700, 3), directions, torch.zeros(700, device=draw.device), count),
        *(everywhere, draw(3, 3, 3, 1)),
        **{**cube, "step": 0.1, "longest": 2, "capacity": 1500},
        thresholds=Thresholds(0.0, 0.0, 0.4),
    )
    canonical, weight = draw(1500, 3).requires_grad_(moves), draw.leaf(1500)
    upstream = draw(capacity, 3), draw(capacity)

    def work() -> Sequence[Tensor]:
        chosen = select_listed(found, canonical, weight, capacity)
        assert chosen.canonical.requires_grad == moves
        loss = (chosen.weight * upstream[1]).sum()
        if moves:
            loss = loss + (chosen.canonical * upstream[0]).sum()
        return *chosen, *torch.autograd.grad(loss, (weight, canonical) if moves else weight)

    agree(work)


@pytest.mark.parametrize("padding", [0, 5, 300])
# Rays without samples at either end and in between; one block of lanes, one more, two and more.
@pytest.mark.parametrize("lengths", [[], [0, 0], [0, 3, 0, 0, 32, 33, 1, 70, 0]])
def test_compositing(draw: Draw, agree: Both, lengths: list[int], padding: int) -> None:
    counts = torch.tensor(lengths, dtype=torch.long)
    first = torch.nn.functional.pad(counts.cumsum(0), (1, 0)).to(draw.device)
    samples, rays = int(first[-1]) + padding, len(lengths)
    # Optical depths from 1e-6 to 5, some as good as infinite.
    depth = 5 * draw(samples).abs() ** 8 + 1e-6
    depth[::25] = 300.0
    to_weights, to_end, leaf = draw(samples), draw(rays), depth.requires_grad_()
    ray = torch.repeat_interleave(counts).to(draw.device)

    def work() -> Sequence[Tensor]:
        weights, end = composite_segments(leaf, first)
        loss = (weights * to_weights).sum() + (end * to_end).sum()
        each = composite(leaf.detach()[: len(ray)], ray, rays)
        return *each, weights.detach(), end.detach(), *torch.autograd.grad(loss, leaf)

    agree(work)


@pytest.mark.parametrize("frozen", [(), (3,), range(8)])
@pytest.mark.parametrize("octaves", [0, 3])
@pytest.mark.parametrize("kept", [False, True])
def test_colors(draw: Draw, agree: Both, octaves: int, frozen: Sequence[int], kept: bool) -> None:
    """Four rays, 100 samples, 30 places of padding; ``kept``: gradients are added to."""
    width, places = 6, 130
    shapes = (width, 7), (width,), (width, 3 + 6 * octaves), (width, width), (width,), (3, width)
    start = [draw(3, 4, 3, 7), *(draw(*shape) for shape in shapes), draw(3)]
    at, directions = draw(places, 3), draw(4, 3)
    ray = (torch.arange(places) % 4).to(draw.device)
    first = torch.tensor([0, 20, 20, 90, 100]).to(draw.device)
    powers = 2.0 ** torch.arange(octaves, device=draw.device)

    def work() -> Sequence[Tensor]:
        points = at.clone().requires_grad_()
        leaves = [value.clone().requires_grad_(k not in frozen) for k, value in enumerate(start)]
        for leaf in leaves:
            leaf.grad = torch.ones_like(leaf) if kept and leaf.requires_grad else None
        network = ColorNetwork(*leaves[1:], powers)
        colors = listed_colors(leaves[0], points, BOX, directions, ray, first, network)
        assert colors.isfinite().all()
        colors[:100].sum().backward()
        learned = [leaf.grad for k, leaf in enumerate([*leaves, points]) if k not in frozen]
        assert all(leaves[k].grad is None for k in frozen)
        return [colors[:100].detach(), *(grad / 10 for grad in learned if grad is not None)]

    agree(work)


@pytest.mark.parametrize("paced", [False, True])
@pytest.mark.parametrize("skip_zero", [False, True])
@pytest.mark.parametrize("shape", [(3, 2, 4, 1), (2, 3, 50, 3), (2, 2, 400, 3)])
def test_adam(
    draw: Draw, agree: Both, shape: tuple[int, ...], skip_zero: bool, paced: bool
) -> None:
    start, factors = 2 * draw(*shape), draw(*shape[:3], 1).abs() if paced else None
    # About half of the entries without a gradient, others in each step.
    gradients = [draw(*shape).clamp(min=0) for _ in range(2)]

    def work() -> Sequence[Tensor]:
        values, mean, square = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
        for number, gradient in enumerate(gradients, start=1):
            rate, step = torch.tensor([0.1, number], device=start.device)
            rule = AdamRule(rate, step, skip_zero=skip_zero, per_voxel_lr=factors)
            grad = gradient.clone()
            add_total_variation_gradient(values, grad, 0.3, touched_only=skip_zero)
            adam_step(values, grad, mean, square, rule)
            assert not grad.any()
        return values, mean, square

    agree(work)
