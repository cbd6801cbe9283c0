"""Adam for grids: entries without gradient stand still, each voxel may have its own rate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from devrf.ops.adam_step import AdamRule, adam_step, smooth_adam_step
from devrf.ops.dispatch import triton_runs
from devrf.ops.total_variation import add_total_variation_gradient


class GridAdam(torch.optim.Optimizer):
    """Adam (Kingma & Ba 2015) with additions for voxel grids.

    Each parameter group takes, beside ``lr``, ``betas`` and ``eps``:

    * ``skip_zero``: an entry whose gradient is exactly zero keeps its value *and its moments*:
      a voxel that no sample of this batch touched is not moved by what was seen before.
    * ``per_voxel_lr``: None, or a tensor (X, Y, Z, 1) of factors of the learning rate.
    * ``smoothing``: weight of the total variation of each grid, whose gradient is added to what
      the backward pass gave.
    * ``touched_only``: add it to entries alone that have a gradient.

    ``lr`` may be a tensor () on the parameters' device. A number is put into one at the beginning
    of :meth:`step`: what :meth:`apply` does then is a matter of the device alone, and may be
    captured in a CUDA graph.

    Attributes:
        keeps_gradients: whether gradients are tensors that stay: zero before each iteration,
            added to by the backward pass, zeroed by the step.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float | Tensor = 1e-3,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-8,
    ) -> None:
        defaults = {
            "lr": lr,
            "betas": betas,
            "eps": eps,
            "skip_zero": False,
            "per_voxel_lr": None,
            "smoothing": 0.0,
            "touched_only": False,
        }
        self.keeps_gradients = False
        self._rates: dict[int, Tensor] = {}
        self._spare: dict[Tensor, Tensor] = {}
        self._work = self.apply
        super().__init__(params, defaults)

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step on every parameter that has a gradient, after ``closure``."""
        result = None
        if closure is not None:
            with torch.enable_grad():
                result = closure()
        for number, group in enumerate(self.param_groups):
            if group["params"] and not isinstance(group["lr"], Tensor):
                device = group["params"][0].device
                rate = self._rates.get(number)
                if rate is None or rate.device != device:
                    rate = self._rates[number] = torch.zeros((), dtype=torch.float64, device=device)
                # A fill, not a copy from the host: the device need not wait.
                rate.fill_(group["lr"])
        with torch.enable_grad():
            self._work()
        return result

    @contextmanager
    def stepping_by(self, work: Callable[[], None]) -> Iterator[None]:
        """Within, :meth:`step` does ``work`` in place of :meth:`apply`, which is part of it.

        For work that is done as a whole, like a captured iteration: callbacks that run before
        a step, and set learning rates, run before all of it.
        """
        usual, self._work = self._work, work
        try:
            yield
        finally:
            self._work = usual

    @torch.no_grad()
    def apply(self) -> None:
        """The step itself, at the rates that :meth:`step` has put on the device."""
        for number, group in enumerate(self.param_groups):
            rate = group["lr"] if isinstance(group["lr"], Tensor) else self._rates.get(number)
            for parameter in group["params"]:
                assert rate is not None
                self._step(parameter, group, rate)

    def _step(self, parameter: Tensor, group: dict[str, Any], rate: Tensor) -> None:
        smoothing, touched_only = group["smoothing"], group["touched_only"]
        if parameter.grad is None:
            if not smoothing or touched_only:
                return
            parameter.grad = torch.zeros_like(parameter)
        gradient, state = parameter.grad, self._state_of(parameter)
        state["steps"] += 1
        rule = AdamRule(
            rate,
            state["steps"],
            group["betas"],
            group["eps"],
            group["skip_zero"],
            group["per_voxel_lr"],
        )
        moments = state["mean"], state["square"]
        tensors = (parameter, gradient, *moments)
        if smoothing and not touched_only and triton_runs(*tensors):
            spare = self._spare_of(parameter)
            smooth_adam_step(parameter, spare, gradient, *moments, rule, smoothing=smoothing)
            parameter.copy_(spare)
            return
        if smoothing:
            add_total_variation_gradient(parameter, gradient, smoothing, touched_only=touched_only)
        adam_step(parameter, gradient, *moments, rule, clear=self.keeps_gradients)

    def _state_of(self, parameter: Tensor) -> dict[str, Any]:
        """How many steps the parameter has taken () and its moments, made when first asked."""
        state: dict[str, Any] = self.state[parameter]
        if not state:
            # Not "step": a loaded state of that name would stay where it was loaded.
            state["steps"] = torch.zeros((), dtype=torch.float64, device=parameter.device)
            state["mean"] = torch.zeros_like(parameter)
            state["square"] = torch.zeros_like(parameter)
        return state

    def _spare_of(self, parameter: Tensor) -> Tensor:
        """Where a parameter's smoothed values are written before they take its place."""
        if parameter not in self._spare:
            self._spare[parameter] = torch.empty_like(parameter, requires_grad=False)
        return self._spare[parameter]

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Remove all gradients; zero them where they are tensors that stay."""
        super().zero_grad(set_to_none and not self.keeps_gradients)

    def drop_gradients(self, parameters: Iterable[Tensor]) -> None:
        """As :meth:`zero_grad`, of some parameters."""
        for parameter in parameters:
            if self.keeps_gradients and parameter.grad is not None:
                parameter.grad.zero_()
            else:
                parameter.grad = None

    def keep_gradients(self) -> None:
        """Let gradients be tensors that stay, those of later parameters too."""
        self.keeps_gradients = True
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take up the state of a run that was left, on the device of the parameters."""
        super().load_state_dict(state_dict)
        for state in self.state.values():
            # torch makes every number of a state one of its parameter's type.
            state["steps"] = state["steps"].double()
        for group in self.param_groups:
            if group["per_voxel_lr"] is not None:
                group["per_voxel_lr"] = group["per_voxel_lr"].to(group["params"][0].device)

    def replace(self, group: int, parameters: Sequence[Tensor], **settings: Any) -> None:
        """Give a group other parameters (a resized grid) with fresh moments.

        Args:
            group: its number.
            parameters: what it is to step on.
            settings: settings of the group that change with them; ``per_voxel_lr`` is None
                unless it is given.
        """
        for old in self.param_groups[group]["params"]:
            self.state.pop(old, None)
            self._spare.pop(old, None)
        self.param_groups[group]["params"] = list(parameters)
        self.param_groups[group].update({"per_voxel_lr": None, **settings})
        if self.keeps_gradients:
            self.keep_gradients()

    def forget(self, group: int) -> None:
        """Begin a group afresh on the same parameters, whose memory holds something else now."""
        for parameter in self.param_groups[group]["params"]:
            for value in self.state.get(parameter, {}).values():
                value.zero_()
            if parameter.grad is not None:
                parameter.grad.zero_()
