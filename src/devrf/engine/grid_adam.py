"""Adam for voxel grids: skips entries without gradient, allows a rate for each voxel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, cast

import torch
from torch import Tensor
from torch.optim.adam import adam

from devrf.kernels.adam import adam_step, add_total_variation_gradient
from devrf.ops.adam import AdamRule
from devrf.system.plain_data import Count, validate

# Devices on which torch's fused Adam is used.
FUSED = ("cpu", "cuda")


class GridAdam(torch.optim.Optimizer):
    """Adam (Kingma & Ba 2015) with additions for voxel grids.

    Each parameter group takes, beside ``lr``, ``betas`` and ``eps``:

    * ``skip_zero``: an entry whose gradient is exactly zero keeps its value *and its moments*:
      momentum does not move a voxel that no sample of this batch touched. Its gradient stays in the
      same memory: to make one anew takes longer than to clear the few rows that were touched.
    * ``rows``: None, or the voxels (K,) outside which no gradient of these grids is read.
    * ``per_voxel_lr``: None, or a tensor (X, Y, Z, 1) of factors of the learning rate.
    * ``smoothing``: weight of the total variation of each grid, whose gradient is added to that
      of the backward pass; ``along_z`` times as much between neighbours along z.
    * ``bound``: of differences between neighbours, beyond which it grows linearly.
    * ``touched_only``: add it only to entries that have a gradient.

    Callbacks read ``name``, ``base_lr`` and ``decay`` (the power of the schedule's factor of the
    rate, 1 if it is not there) of each group of a stage's optimiser.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-8,
    ) -> None:
        defaults = {
            "lr": lr,
            "betas": betas,
            "eps": eps,
            "skip_zero": False,
            "per_voxel_lr": None,
            "rows": None,
            "smoothing": 0.0,
            "along_z": 1.0,
            "bound": 1.0,
            "touched_only": False,
        }
        super().__init__(params, defaults)

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step on every parameter that has a gradient, after ``closure``.

        Gradients are zero afterwards where they are kept, and gone elsewhere.
        """
        result = None
        if closure is not None:
            with torch.enable_grad():
                result = closure()
        for group in self.param_groups:
            self._step(group)
        return result

    @torch.no_grad()
    def _step(self, group: dict[str, Any]) -> None:
        """One step on the parameters of a group."""
        learned = self._learned(group)
        for parameter in learned:
            self._state_of(parameter)["steps"] += 1
            if group["smoothing"]:
                assert parameter.grad is not None
                add_total_variation_gradient(
                    parameter,
                    parameter.grad,
                    group["smoothing"],
                    along_z=group["along_z"],
                    bound=group["bound"],
                    touched_only=group["touched_only"],
                )
        if group["skip_zero"] or group["per_voxel_lr"] is not None:
            self._step_by_voxel(learned, group)
        elif learned:
            self._step_alike(learned, group)
        for parameter in learned if not group["skip_zero"] else ():
            parameter.grad = None

    def _step_by_voxel(self, learned: Sequence[Tensor], group: dict[str, Any]) -> None:
        """A step that skips voxels, or has a learning rate for each voxel."""
        for parameter in learned:
            gradient = parameter.grad
            state = self.state[parameter]
            assert gradient is not None
            rule = AdamRule(
                rate=group["lr"],
                step=state["steps"],
                betas=group["betas"],
                eps=group["eps"],
                skip_zero=group["skip_zero"],
                per_voxel_lr=group["per_voxel_lr"],
            )
            adam_step(
                parameter,
                gradient,
                mean=state["mean"],
                square=state["square"],
                rule=rule,
                rows=group["rows"],
            )

    def _step_alike(self, learned: Sequence[Tensor], group: dict[str, Any]) -> None:
        """A step on all numbers alike, by torch: on a CPU in a seventh of the kernel's time."""
        states = [self.state[parameter] for parameter in learned]
        fused = learned[0].device.type in FUSED
        # Filled there: to copy a number to a GPU waits for it.
        counts_on = learned[0].device if fused else "cpu"
        steps = [state["steps"] - 1.0 for state in states]
        if len(set(steps)) == 1:
            counts = list(torch.full((len(steps),), steps[0], device=counts_on).unbind())
        else:
            counts = [torch.full((), step, device=counts_on) for step in steps]
        beta1, beta2 = group["betas"]
        adam(
            list(learned),
            [cast(Tensor, parameter.grad) for parameter in learned],
            [state["mean"] for state in states],
            [state["square"] for state in states],
            max_exp_avg_sqs=[],
            state_steps=counts,
            fused=fused,
            amsgrad=False,
            beta1=beta1,
            beta2=beta2,
            lr=group["lr"],
            weight_decay=0.0,
            eps=group["eps"],
            maximize=False,
        )

    def _learned(self, group: dict[str, Any]) -> list[Tensor]:
        """The group's parameters that have a gradient, or get one from their total variation."""
        learned = []
        for parameter in group["params"]:
            if parameter.grad is None:
                if not group["smoothing"] or group["touched_only"]:
                    continue
                parameter.grad = torch.zeros_like(parameter)
            learned.append(parameter)
        return learned

    def _state_of(self, parameter: Tensor) -> dict[str, Any]:
        """The parameter's number of steps and its moments; zero at first."""
        state: dict[str, Any] = self.state[parameter]
        if not state:
            state["steps"] = 0
            state["mean"] = torch.zeros_like(parameter)
            state["square"] = torch.zeros_like(parameter)
        return state

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Remove all gradients; those that are kept are set to zero."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if group["skip_zero"] and parameter.grad is not None:
                    parameter.grad.zero_()
                else:
                    parameter.grad = None

    def make_gradients(self) -> None:
        """Make those gradients that are kept and are not there yet, before a backward pass."""
        for group in self.param_groups:
            for parameter in group["params"] if group["skip_zero"] else ():
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore moments and steps; settings stay those that the stage has chosen.

        So no index of a voxel comes from a file: kernels check none.

        Raises:
            ValueError: moments that do not fit the parameters.
        """
        settings = [dict(group) for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, own in zip(self.param_groups, settings, strict=True):
            group |= own
            for parameter in group["params"]:
                if parameter in self.state:
                    state = self.state[parameter]
                    state["steps"] = validate(Count, state["steps"])
                    if not parameter.shape == state["mean"].shape == state["square"].shape:
                        raise ValueError("moments of another shape than what is learned")

    def replace(
        self,
        group: int,
        parameters: Sequence[Tensor],
        source: Tensor | None = None,
        **settings: Any,
    ) -> None:
        """Give a group other parameters, such as a resized grid, with zero moments.

        Args:
            group: its index.
            parameters: the new parameters.
            source: (M,) int64, the rows of the old parameters whose moments the M rows of the new
                ones take over; −1: none.
            settings: further settings of the group; ``per_voxel_lr`` and ``rows`` are None unless
                given.
        """
        states = [self.state.pop(old, None) for old in self.param_groups[group]["params"]]
        if source is not None:
            for state, new in zip(states, parameters, strict=True):
                if state:
                    fresh = (source < 0).view(-1, *[1] * (new.ndim - 1))
                    for moment in ("mean", "square"):
                        rows = state[moment].index_select(0, source.clamp(min=0))
                        state[moment] = rows.masked_fill(fresh, 0.0)
                    self.state[new] = state
        self.param_groups[group]["params"] = list(parameters)
        self.param_groups[group].update({"per_voxel_lr": None, "rows": None, **settings})
        self.make_gradients()

    def forget(self) -> None:
        """Forget all moments, step counts and gradients; the parameters stay."""
        self.state.clear()
        self.zero_grad()
