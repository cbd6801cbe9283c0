"""GridAdam against torch's Adam, and its additions by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from devrf.engine.grid_adam import GridAdam
from devrf.kernels.adam import add_total_variation_gradient

SHAPE = (2, 3, 2, 2)


def gradients(rng: torch.Generator, count: int) -> list[Tensor]:
    """Gradients without any zero."""
    return [torch.randn(SHAPE, generator=rng, dtype=torch.float64) + 0.01 for _ in range(count)]


def run(optimizer: torch.optim.Optimizer, parameter: Tensor, grads: list[Tensor]) -> Tensor:
    for grad in grads:
        parameter.grad = grad.clone()
        optimizer.step()
    return parameter.detach()


@pytest.mark.parametrize("skip_zero", [False, True])
def test_is_adam_except_where_entries_are_skipped(rng: torch.Generator, skip_zero: bool) -> None:
    start, grads = torch.randn(SHAPE, generator=rng, dtype=torch.float64), gradients(rng, 12)
    if not skip_zero:
        grads = [grad.clamp(min=0) for grad in grads]
    ours, theirs = (start.clone().requires_grad_() for _ in range(2))
    grid = GridAdam([{"params": [ours], "skip_zero": skip_zero}], lr=0.1)
    adam = torch.optim.Adam([theirs], lr=0.1, betas=(0.9, 0.99), eps=1e-8)
    torch.testing.assert_close(run(grid, ours, grads), run(adam, theirs, grads))


def test_an_entry_without_gradient_keeps_value_and_moments() -> None:
    parameter = torch.zeros(1, 1, 2, 2, requires_grad=True)
    optimizer = GridAdam([{"params": [parameter], "skip_zero": True}], lr=0.1)
    # Entry (0, 1) shares its row with a touched one; the second row is not touched at all.
    run(optimizer, parameter, [torch.full((1, 1, 2, 2), 2.0)])
    before = {k: v.clone() for k, v in optimizer.state[parameter].items() if k != "steps"}
    value = parameter.detach().clone()
    run(optimizer, parameter, [torch.tensor([[3.0, 0.0], [0.0, 0.0]]).view(1, 1, 2, 2)])
    state = optimizer.state[parameter]
    still = torch.tensor([[False, True], [True, True]]).view(1, 1, 2, 2)
    assert torch.equal(parameter[still], value[still])
    for name in ("mean", "square"):
        assert torch.equal(state[name][still], before[name][still])
    # The touched one by hand: m = 0.9·0.2 + 0.1·3, v = 0.99·0.04 + 0.01·9, second step.
    assert state["mean"][0, 0, 0, 0].item() == pytest.approx(0.48)
    assert state["square"][0, 0, 0, 0].item() == pytest.approx(0.1296, rel=1e-5)
    move = 0.1 * (0.48 / (1 - 0.9**2)) / math.sqrt(0.1296 / (1 - 0.99**2))
    assert parameter[0, 0, 0, 0].item() == pytest.approx(-0.1 - move, rel=1e-5)
    # The memory of its gradient is cleared, not given back.
    assert parameter.grad is not None and not parameter.grad.any()


@pytest.mark.parametrize("skip_zero", [False, True])
def test_the_rate_of_each_voxel_is_scaled(rng: torch.Generator, skip_zero: bool) -> None:
    factors = torch.rand(*SHAPE[:3], 1, generator=rng, dtype=torch.float64)
    grads = gradients(rng, 5)
    scaled, plain = (torch.zeros(SHAPE, dtype=torch.float64, requires_grad=True) for _ in range(2))
    slow = GridAdam([{"params": [scaled], "per_voxel_lr": factors, "skip_zero": skip_zero}], lr=0.1)
    # The moments do not depend on the values, so each move is the plain one times its factor.
    moved = run(slow, scaled, grads)
    torch.testing.assert_close(moved, factors * run(GridAdam([plain], lr=0.1), plain, grads))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_only_rows_that_are_given_move(rng: torch.Generator, dtype: torch.dtype) -> None:
    rows = torch.tensor([1, 4, 11], dtype=torch.int32)
    inside = torch.zeros(12, 1, dtype=torch.bool).index_fill_(0, rows.long(), True).view(2, 3, 2, 1)
    grads = [(grad * inside).to(dtype) for grad in gradients(rng, 3)]
    ours, theirs = (torch.zeros(SHAPE, dtype=dtype, requires_grad=True) for _ in range(2))
    some = GridAdam([{"params": [ours], "skip_zero": True, "rows": rows}])
    every = GridAdam([{"params": [theirs], "skip_zero": True}])
    run(every, theirs, grads)
    assert torch.equal(run(some, ours, grads), theirs)
    assert torch.equal(ours != 0, inside.expand(SHAPE))


def test_a_stored_state_chooses_no_memory(rng: torch.Generator) -> None:
    """Kernels check no index and no shape, so both come from the optimiser and its parameters."""
    parameter, rows = torch.zeros(SHAPE, requires_grad=True), torch.tensor([1, 4]).int()
    optimizer = GridAdam([{"params": [parameter], "skip_zero": True, "rows": rows}])
    run(optimizer, parameter, [grad.float() for grad in gradients(rng, 1)])
    stored = optimizer.state_dict()
    stored["param_groups"][0]["rows"] = torch.tensor([2**30])
    optimizer.load_state_dict(stored)
    assert optimizer.param_groups[0]["rows"] is rows
    for name in ("mean", "square"):
        smaller = {**stored["state"][0], name: torch.zeros(1, 3)}
        with pytest.raises(ValueError, match="moments of another shape"):
            optimizer.load_state_dict({**stored, "state": {0: smaller}})
    for nothing in ([], None):
        with pytest.raises(TypeError):
            optimizer.load_state_dict({**stored, "state": {0: nothing}})


def test_a_parameter_without_gradient_is_not_moved_and_the_closure_is_called() -> None:
    parameter = torch.ones(1, 1, 1, 1, requires_grad=True)
    other = torch.ones(1, 1, 1, 1, requires_grad=True)
    optimizer = GridAdam([parameter, other], lr=0.1)

    def closure() -> Tensor:
        loss = 2 * parameter.sum()
        loss.backward()
        return loss

    assert optimizer.step(closure).item() == 2.0
    assert parameter.item() == pytest.approx(0.9) and other.item() == 1.0


@pytest.mark.parametrize("touched_only", [False, True])
def test_smoothing_adds_the_gradient_of_the_total_variation(
    rng: torch.Generator, touched_only: bool
) -> None:
    start, grads = torch.randn(SHAPE, generator=rng, dtype=torch.float64), gradients(rng, 5)
    grads = [grad.clamp(min=0) for grad in grads]
    ours, theirs = (start.clone().requires_grad_() for _ in range(2))
    settings = {"smoothing": 0.4, "along_z": 0.5, "touched_only": touched_only}
    smooth = GridAdam([{"params": [ours], **settings}], lr=0.1)
    plain = GridAdam([theirs], lr=0.1)
    for grad in grads:
        more = torch.zeros_like(grad)
        add_total_variation_gradient(theirs.detach(), more, 0.4, along_z=0.5)
        run(plain, theirs, [grad + (more * (grad != 0) if touched_only else more)])
        run(smooth, ours, [grad])
    torch.testing.assert_close(ours, theirs)


def test_gradients_of_skipping_groups_stay_where_they_are_and_are_zero_after_a_step() -> None:
    kept, other = (torch.ones(1, 1, 1, 2, requires_grad=True) for _ in range(2))
    optimizer = GridAdam([{"params": [kept], "skip_zero": True}, {"params": [other]}])
    optimizer.make_gradients()
    place = kept.grad
    assert place is not None and other.grad is None
    (2 * kept.sum() + other.sum()).backward()
    assert kept.grad is place and place.flatten().tolist() == [2, 2]
    optimizer.step()
    assert kept.grad is place and not place.any() and other.grad is None
    assert kept[0, 0, 0, 0].item() == pytest.approx(1 - 1e-3)
    (kept.sum() + other.sum()).backward()
    optimizer.zero_grad()
    assert kept.grad is place and not place.any() and other.grad is None
    larger = torch.ones(1, 1, 2, 2, requires_grad=True)
    optimizer.replace(0, [larger])
    assert larger.grad is not None


def test_what_is_replaced_or_forgotten_starts_afresh() -> None:
    old, new = (torch.zeros(1, 1, 1, 1, requires_grad=True) for _ in range(2))
    optimizer = GridAdam([old], lr=0.1)
    run(optimizer, old, [torch.ones(1, 1, 1, 1)] * 3)
    optimizer.replace(0, [new])
    assert old not in optimizer.state
    optimizer.forget()
    run(optimizer, new, [torch.full((1, 1, 1, 1), -5.0)])
    assert new.item() == pytest.approx(0.1) and old.item() == pytest.approx(-0.3)
    optimizer.forget()
    run(optimizer, new, [torch.full((1, 1, 1, 1), 5.0)])
    assert new.item() == pytest.approx(0.0, abs=1e-7)


def test_rows_that_stay_keep_their_moments_and_new_ones_have_none() -> None:
    old = torch.zeros(3, 2, requires_grad=True)
    optimizer = GridAdam([old], lr=0.1)
    slopes = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    run(optimizer, old, [slopes] * 2)
    mean, square = (optimizer.state[old][name] for name in ("mean", "square"))
    new = old.detach()[[2, 0, 0]].clone().requires_grad_()
    optimizer.replace(0, [new], source=torch.tensor([2, 0, -1]))
    assert old not in optimizer.state and optimizer.state[new]["steps"] == 2
    for name, before in (("mean", mean), ("square", square)):
        after = optimizer.state[new][name]
        assert torch.equal(after[:2], before[[2, 0]]) and not after[2].any()
    run(optimizer, new, [slopes])
    assert optimizer.state[new]["steps"] == 3


def test_the_rate_may_be_set_by_the_closure() -> None:
    parameter = torch.zeros(1, 1, 1, 1, requires_grad=True)
    optimizer = GridAdam([parameter], lr=0.5)

    def closure() -> None:
        optimizer.param_groups[0]["lr"] = 0.25
        parameter.grad = torch.ones(1, 1, 1, 1)

    optimizer.step(closure)
    assert parameter.item() == pytest.approx(-0.25) and parameter.grad is None
