"""Results of kernels for autograd, with adjoints written by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def with_adjoint(
    results: Sequence[Tensor],
    learned: Sequence[Tensor | None],
    adjoint: Callable[..., Sequence[Tensor | None]],
) -> tuple[Tensor, ...]:
    """``results`` of kernels as a function of the tensors ``learned``, differentiable once.

    Args:
        results: without gradients.
        learned: what they depend on; None: what is absent.
        adjoint: the gradients of ``learned``, from those of the results; None: it has none.
    """
    attached: tuple[Tensor, ...] = _WithAdjoint.apply(adjoint, results, *learned)  # type: ignore[no-untyped-call]
    return attached


class _WithAdjoint(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, adjoint: Callable[..., Any], results: Sequence[Tensor], *learned: Tensor | None
    ) -> tuple[Tensor, ...]:
        ctx.adjoint = adjoint
        ctx.save_for_backward(*learned)
        # Else results that the adjoint reads would refer to themselves, and live for ever.
        return tuple(result.detach() for result in results)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors  # an error where one was changed in place since
        return None, None, *ctx.adjoint(*(gradient.contiguous() for gradient in gradients))
