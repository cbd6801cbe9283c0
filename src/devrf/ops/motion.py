"""The equations of the cycle and the flow term. See docs/method.md#motion-losses."""

from __future__ import annotations

from torch import Tensor


def cycle_error(points: Tensor, returned: Tensor) -> Tensor:
    """½ |x − (q + Δ_f(q))|² (K,) of samples x (K, 3) and of where they return to (K, 3)."""
    return 0.5 * (points - returned).square().sum(dim=1)


def flow_error(weight: Tensor, induced: Tensor, observed: Tensor, count: Tensor) -> Tensor:
    """(1/M) Σ_i w_i |φ_i − φ|₁ ().

    Args:
        weight: (K,) w of the samples on rays with flow.
        induced: (K, 2) φ_i in pixels.
        observed: (K, 2) φ of their rays.
        count: () M.
    """
    return (weight * (induced - observed).abs().sum(dim=1)).sum() / count.clamp(min=1)
