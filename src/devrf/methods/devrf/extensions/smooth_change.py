"""The change of a displacement grid that explains what is seen, and is smooth."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from devrf.engine.grid_adam import GridAdam

# A change (X, Y, Z, 3) and the number of the step → how badly it explains what is seen.
Misfit = Callable[[Tensor, int], Tensor]
# How far a value goes in the first step, in pixels.
FASTEST = 1.0


@torch.enable_grad()
def smooth_change(
    misfit: Misfit, like: Tensor, scale: float, steps: int, smoothness: float
) -> Tensor:
    """The change c of a grid that makes misfit(c) + λ ‖∇c‖² small, begun at zero.

    ‖∇c‖² is the mean over voxels of the squared differences between neighbours, in pixels.

    Args:
        misfit: has a gradient.
        like: a grid (X, Y, Z, 3) of the shape and device wanted.
        scale: pixels per unit of the grid's values.
        steps: Adam steps; the rate falls linearly from :data:`FASTEST` to zero.
        smoothness: λ.
    """
    change = torch.zeros_like(like).requires_grad_()
    optimizer = GridAdam([change], lr=FASTEST / scale, betas=(0.8, 0.9))
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = FASTEST / scale * (1 - step / steps)
        optimizer.zero_grad()
        rough = sum(change.diff(dim=axis).square().sum() for axis in range(3)) * scale**2
        loss: Tensor = misfit(change, step) + smoothness * rough / like.shape[:3].numel()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return change.detach()
