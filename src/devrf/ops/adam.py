"""Adam for grids: entries without gradient stand still, each voxel may have its own pace."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor


class GridAdam(torch.optim.Optimizer):
    """Adam (Kingma & Ba 2015) with two additions for voxel grids (method §2, Optimiser).

    Each parameter group takes, beside ``lr``, ``betas`` and ``eps``:

    * ``skip_zero``: an entry whose gradient is exactly zero keeps its value *and its moments*:
      a voxel that no sample of this batch touched is not moved by what was seen before.
    * ``pace``: None, or a tensor (X, Y, Z, 1) that multiplies the learning rate voxel by voxel.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
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
                state = self.state[parameter]
                if not state:
                    state["step"] = 0
                    state["mean"] = torch.zeros_like(parameter)
                    state["square"] = torch.zeros_like(parameter)
                state["step"] += 1
                update = _update_touched if group["skip_zero"] else _update_all
                update(parameter, parameter.grad, state, group)
        return result

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take up the state of a run that was left, on the device of the parameters."""
        super().load_state_dict(state_dict)
        for group in self.param_groups:
            if group["pace"] is not None:
                group["pace"] = group["pace"].to(group["params"][0].device)

    def replace(self, group: int, parameters: Sequence[Tensor], pace: Tensor | None = None) -> None:
        """Give a group other parameters (a resized grid, the next frame) with fresh moments."""
        for old in self.param_groups[group]["params"]:
            self.state.pop(old, None)
        self.param_groups[group]["params"] = list(parameters)
        self.param_groups[group]["pace"] = pace


def _update_all(parameter: Tensor, grad: Tensor, state: dict[str, Any], group: Any) -> None:
    beta1, beta2 = group["betas"]
    mean, square = state["mean"], state["square"]
    mean.lerp_(grad, 1 - beta1)
    square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
    size, correction = _step_size(state["step"], group)
    move = mean / (square / correction).sqrt_().add_(group["eps"])
    if group["pace"] is not None:
        move *= group["pace"]
    parameter.sub_(move, alpha=size)


def _update_touched(parameter: Tensor, grad: Tensor, state: dict[str, Any], group: Any) -> None:
    """As :func:`_update_all` on the rows with a gradient: most of a grid is not touched."""
    beta1, beta2 = group["betas"]
    channels = parameter.shape[-1]
    flat_grad = grad.reshape(-1, channels)
    rows = (flat_grad != 0).any(dim=1).nonzero()[:, 0]
    g = flat_grad[rows]
    touched = g != 0
    means = state["mean"].view(-1, channels)
    squares = state["square"].view(-1, channels)
    mean, square = means[rows], squares[rows]
    mean = torch.where(touched, mean + (1 - beta1) * (g - mean), mean)
    square = torch.where(touched, square + (1 - beta2) * (g * g - square), square)
    means[rows], squares[rows] = mean, square
    size, correction = _step_size(state["step"], group)
    move = mean / (square / correction).sqrt_().add_(group["eps"])
    if group["pace"] is not None:
        move *= group["pace"].view(-1, 1)[rows]
    values = parameter.view(-1, channels)
    values[rows] = values[rows] - size * torch.where(touched, move, torch.zeros_like(move))


def _step_size(step: int, group: Any) -> tuple[float, float]:
    """Learning rate with the mean's bias correction, and the square's correction."""
    beta1, beta2 = group["betas"]
    return group["lr"] / (1 - beta1**step), 1 - beta2**step
