"""Colours of rays and the photometric terms, in both implementations and by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from devrf.ops.compositing import composite_colors
from devrf.ops.dispatch import using
from devrf.ops.photometric import photometric_sum
from devrf.ops.selfcheck import Draw, compositing_colors

Both = Callable[[Callable[[], Sequence[Tensor]]], None]


def test_both_implementations_agree(agree: Both, device: torch.device) -> None:
    agree(lambda: compositing_colors(Draw(device)))


@pytest.mark.parametrize("kernels", ["torch", "triton"])
def test_colors_by_hand(device: torch.device, kernels: str) -> None:
    # Two samples on the first ray, none on the second, and a place of padding.
    weights, distance = torch.tensor([0.5, 0.25, 7.0]), torch.tensor([2.0, 4.0, 9.0])
    colors = torch.tensor([[1.0, 0, 0], [0, 1, 0], [5, 5, 5]])
    first, left = torch.tensor([0, 2, 2]), torch.tensor([0.25, 1.0])
    given = [t.to(device) for t in (weights, colors, distance, first, left, torch.ones(3))]
    with using(kernels):  # type: ignore[arg-type]
        image, depth = composite_colors(*given)
    assert image.tolist() == [[0.75, 0.5, 0.25], [1.0, 1.0, 1.0]]
    assert depth.tolist() == pytest.approx([2 / 0.75, 0.0])


@pytest.mark.parametrize("kernels", ["torch", "triton"])
@pytest.mark.parametrize("matte", [False, True])
def test_terms_by_hand(device: torch.device, kernels: str, matte: bool) -> None:
    image = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    left, truth = torch.tensor([0.5, 0.25]), torch.zeros(2, 3)
    weights, colors = torch.tensor([0.5, 3.0]), torch.tensor([[1.0, 1.0, 0.0], [9.0, 9.0, 9.0]])
    given = [image, left.requires_grad_(), weights, colors.requires_grad_()]
    given += [torch.tensor([0, 1, 1]), truth]  # the second place is padding
    alpha = torch.tensor([1.0, 1.0]) if matte else None
    on_device = [
        tensor.detach().to(device).requires_grad_(tensor.requires_grad) for tensor in given
    ]
    with using(kernels):  # type: ignore[arg-type]
        found = photometric_sum(
            *on_device, None if alpha is None else alpha.to(device), (1.0, 2.0, 0.0, 4.0)
        )
        found.total.backward()
    ln2, quarter = 0.6931472, 0.5623351
    bare = (0.25 + 0.0625) / 2 if matte else 0.0
    assert found.terms.tolist() == pytest.approx(
        [0.25 / 6, 0.5 * 2 / 2, (ln2 + quarter) / 2, bare], rel=1e-5
    )
    assert found.total.item() == pytest.approx(0.25 / 6 + 2 * 0.5 + 4 * bare, rel=1e-5)
    assert found.opacity.item() == pytest.approx(1 - 0.375)
    assert (found.coverage is not None) == matte
    assert found.coverage is None or found.coverage.item() == 1
    assert on_device[1].grad is not None and on_device[3].grad is not None
    # 4 · 2 (T − 0) / R.
    assert on_device[1].grad.tolist() == pytest.approx([2.0, 1.0] if matte else [0.0, 0.0])
    # 2 · 2 · w · c / R; nothing for the padding.
    assert on_device[3].grad.tolist() == [[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
