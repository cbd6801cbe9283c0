"""Adam for grids: entries without gradient stand still, each voxel may have its own pace."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from devrf.ops.adam_step import AdamRule, adam_step


class GridAdam(torch.optim.Optimizer):
    """Adam (Kingma & Ba 2015) with two additions for voxel grids (method §2, Optimiser).

    Each parameter group takes, beside ``lr``, ``betas`` and ``eps``:

    * ``skip_zero``: an entry whose gradient is exactly zero keeps its value *and its moments*:
      a voxel that no sample of this batch touched is not moved by what was seen before.
    * ``pace``: None, or a tensor (X, Y, Z, 1) that multiplies the learning rate voxel by voxel.

    ``lr`` may be a tensor () on the parameters' device: a captured CUDA graph then follows it.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float | Tensor = 1e-3,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-8,
    ) -> None:
        defaults = {"lr": lr, "betas": betas, "eps": eps, "skip_zero": False, "pace": None}
        super().__init__(params, defaults)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step on every parameter that has a gradient."""
        result = None
        if closure is not None:
            with torch.enable_grad():
                result = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self._state_of(parameter)
                state["steps"] += 1
                rule = AdamRule(
                    _as_tensor(group["lr"], parameter.device), state["steps"], group["betas"],
                    group["eps"], group["skip_zero"], group["pace"],
                )
                adam_step(
                    parameter, parameter.grad, state["mean"], state["square"], rule, clear=False
                )
        return result

    def _state_of(self, parameter: Tensor) -> dict[str, Any]:
        """How many steps the parameter has taken () and its moments, made when first asked."""
        state: dict[str, Any] = self.state[parameter]
        if not state:
            # Not "step": a loaded state of that name would stay where it was loaded.
            state["steps"] = torch.zeros((), dtype=torch.float64, device=parameter.device)
            state["mean"] = torch.zeros_like(parameter)
            state["square"] = torch.zeros_like(parameter)
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take up the state of a run that was left, on the device of the parameters."""
        super().load_state_dict(state_dict)
        for state in self.state.values():
            # torch makes every number of a state one of its parameter's type.
            state["steps"] = state["steps"].double()
        for group in self.param_groups:
            if group["pace"] is not None:
                group["pace"] = group["pace"].to(group["params"][0].device)

    def replace(self, group: int, parameters: Sequence[Tensor], pace: Tensor | None = None) -> None:
        """Give a group other parameters (a resized grid, the next frame) with fresh moments."""
        for old in self.param_groups[group]["params"]:
            self.state.pop(old, None)
        self.param_groups[group]["params"] = list(parameters)
        self.param_groups[group]["pace"] = pace


def _as_tensor(rate: float | Tensor, device: torch.device) -> Tensor:
    if isinstance(rate, Tensor):
        return rate
    # A fill, not a copy from the host: the device need not wait.
    return torch.full((), rate, dtype=torch.float64, device=device)
