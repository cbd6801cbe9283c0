"""The colour network in one pass: in both implementations, with padding and kept gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.ops import color_network
from devrf.ops.color_network import ColorNetwork, listed_colors
from devrf.ops.dispatch import using
from devrf.ops.selfcheck import Draw, compare, reduced_color_network
from devrf.ops.selfcheck import color_network as both_networks

Both = Callable[[Callable[[], Sequence[Tensor]]], None]
BOX = Box((-1.0, -0.9, -0.8), (0.9, 1.0, 0.7))
PLACES = 130


def test_both_implementations_agree(agree: Both, device: torch.device) -> None:
    agree(lambda: both_networks(Draw(device)))


def test_both_agree_in_half_precision(device: torch.device) -> None:
    assert compare(reduced_color_network, device).agrees


class Listed:
    """Samples of four rays, 100 of them, 30 places of padding behind, and what learns."""

    def __init__(self, device: torch.device, octaves: int = 1, width: int = 6) -> None:
        draw = Draw(device)
        self.grid = draw.leaf(3, 4, 3, 7)
        shapes = (width, 7), (width,), (width, 3 + 6 * octaves), (width, width), (width,)
        self.weights = [draw.leaf(*shape) for shape in (*shapes, (3, width), (3,))]
        self.octaves = 2.0 ** torch.arange(octaves, device=device)
        self.points, self.directions = draw.leaf(PLACES, 3), draw(4, 3)
        self.ray = (torch.arange(PLACES) % 4).to(device)
        self.first = torch.tensor([0, 20, 20, 90, 100]).to(device)

    @property
    def leaves(self) -> list[Tensor]:
        return [self.points, self.grid, *self.weights]

    def colors(self, precision: torch.dtype = torch.float32) -> Tensor:
        network = ColorNetwork(*[*self.weights, self.octaves])
        listed = self.directions, self.ray, self.first, network, precision
        return listed_colors(self.grid, self.points, BOX, *listed)


@pytest.mark.parametrize("octaves", [0, 3])
def test_padding_is_finite_and_teaches_nothing(
    agree: Both, device: torch.device, octaves: int
) -> None:
    listed = Listed(device, octaves)

    def work() -> list[Tensor]:
        colors = listed.colors()
        assert colors.isfinite().all()
        upstream = torch.ones_like(colors)
        upstream[100:] = 0
        return [colors[:100], *torch.autograd.grad(colors, listed.leaves, upstream)]

    agree(work)


def test_gradients_that_exist_are_added_to(device: torch.device) -> None:
    listed = Listed(device)
    with using("triton"):
        fresh = torch.autograd.grad(listed.colors().sum(), listed.leaves)
        for leaf in listed.leaves:
            leaf.grad = torch.ones_like(leaf)
        kept = [leaf.grad for leaf in listed.leaves]
        listed.colors().sum().backward()
    for leaf, before, gradient in zip(listed.leaves, kept, fresh, strict=True):
        assert leaf.grad is before
        torch.testing.assert_close(leaf.grad, 1 + gradient, rtol=1e-4, atol=1e-5)


def test_what_is_frozen_gets_no_gradient(device: torch.device) -> None:
    for frozen in ([3], [0, 1, 2, 3, 4, 5, 6, 7]):
        listed, expected = Listed(device), Listed(device)
        kept = [index for index in range(8) if index not in frozen]
        # Of the grid and the weights: directions alone, or all.
        for index in frozen:
            [listed.grid, *listed.weights][index].requires_grad_(False)
        with using("triton"):
            listed.colors().sum().backward()
        with using("torch"):
            expected.colors()[:100].sum().backward()
        ours = [listed.grid, *listed.weights]
        assert all(ours[index].grad is None for index in frozen)
        theirs = [expected.grid, *expected.weights]
        pairs = [(listed.points, expected.points), *((ours[k], theirs[k]) for k in kept)]
        for found, truth in pairs:
            assert found.grad is not None and truth.grad is not None
            torch.testing.assert_close(found.grad, truth.grad, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("width", "precision", "fused"),
    [
        (6, torch.float32, True),
        (33, torch.float32, False),
        (33, torch.float16, True),
        (129, torch.float16, False),
        # Triton's interpreter cannot multiply bfloat16.
        (6, torch.bfloat16, False),
    ],
)
def test_what_a_program_has_no_room_for_is_left_to_torch(
    monkeypatch: pytest.MonkeyPatch, width: int, precision: torch.dtype, fused: bool
) -> None:
    pytest.importorskip("triton")
    decoded: list[Any] = []
    usual = color_network.decode

    def watched(*args: Any) -> Tensor:
        decoded.append(args)
        return usual(*args)

    monkeypatch.setattr(color_network, "decode", watched)
    listed = Listed(torch.device("cpu"), width=width)
    with using("triton"):
        listed.colors(precision)
    assert bool(decoded) != fused
