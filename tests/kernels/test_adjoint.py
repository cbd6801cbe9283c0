"""Results of kernels in autograd's graph."""

from __future__ import annotations

import gc
import weakref

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.kernels.adjoint import with_adjoint
from devrf.kernels.trilinear import interpolate


def attached(learned: Tensor) -> Tensor:
    """e^x with its adjoint, which reads it."""
    result = learned.detach().exp()
    return with_adjoint((result,), (learned,), lambda gradient: (gradient * result,))[0]


def test_a_result_that_its_adjoint_reads_is_freed_with_the_graph() -> None:
    learned = torch.ones(3, requires_grad=True)
    result = attached(learned)
    result.sum().backward()
    assert torch.equal(learned.grad, result)
    gone = weakref.ref(result)
    gc.disable()
    try:
        del result
        assert gone() is None
    finally:
        gc.enable()


def test_what_was_changed_in_place_since_has_no_gradient() -> None:
    grid = torch.ones(2, 2, 2, 1, requires_grad=True)
    values = interpolate(grid, torch.full((1, 3), 0.5), Box((0.0,) * 3, (1.0,) * 3))
    with torch.no_grad():
        grid += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        values.sum().backward()
