"""The change of a displacement grid that explains what is seen, and is smooth."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from devrf.engine.grid_adam import GridAdam
from devrf.geometry.box import Box
from devrf.kernels.trilinear import interpolate

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


def led_back(
    backward: Tensor,
    forward: Tensor,
    points: Tensor,
    box: Box,
    scale: float,
    steps: int,
    smoothness: float,
) -> Tensor:
    """Δ_b, changed so that it leads the points q back from where they arrive, q + Δ_f(q).

    Without points it stays as it is.

    Args:
        backward: (X, Y, Z, 3) Δ_b to begin with.
        forward: (X, Y, Z, 3) Δ_f.
        points: (N, 3) q.
        box: of the grids.
        scale: pixels per unit of length.
        steps: of the fit.
        smoothness: of the change, see :func:`smooth_change`.
    """
    if len(points) == 0:
        return backward
    arrived = points + interpolate(forward, points, box)
    lost = arrived + interpolate(backward, arrived, box) - points

    def round_trip(change: Tensor, step: int) -> Tensor:
        return robust((lost + interpolate(change, arrived, box)) * scale)

    change = smooth_change(
        round_trip, like=backward, scale=scale, steps=steps, smoothness=smoothness
    )
    return backward + change


def robust(residuals: Tensor) -> Tensor:
    """The mean Huber error of residuals (N, 2 or 3) in pixels."""
    return huber_loss(residuals, torch.zeros_like(residuals), delta=1.0)
