"""Functions of one number that stay accurate where the plain formula cancels.

The hardware's exponential has a relative error of about 1e-7, its logarithm an absolute one of
1e-7; so no logarithm is used.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def softplus(x):
    """log(1 + exp(x)) = max(x, 0) + log(1 + e), e = exp(−|x|) ≤ 1.

    With s = e / (2 + e) ≤ 1/3, log(1 + e) = 2·artanh(s) = 2·(s + s³/3 + s⁵/5 + …).
    """
    e = tl.exp(-tl.abs(x))
    s = e / (2.0 + e)
    q = s * s
    series = 1.0 / 13.0 + q * (1.0 / 15.0)
    series = 1.0 / 11.0 + q * series
    series = 1.0 / 9.0 + q * series
    series = 1.0 / 7.0 + q * series
    series = 1.0 / 5.0 + q * series
    series = 1.0 / 3.0 + q * series
    return tl.maximum(x, 0.0) + 2.0 * s * (1.0 + q * series)


@triton.jit
def sigmoid(x):
    """1 / (1 + exp(−x)), the slope of softplus."""
    e = tl.exp(-tl.abs(x))
    return tl.where(x >= 0.0, 1.0, e) / (1.0 + e)


@triton.jit
def opacity(tau):
    """1 − exp(−τ) for τ ≥ 0; for small τ by its series, whose next term is below 1e-7 of it."""
    series = 1.0 - tau * (1.0 / 6.0)
    series = 1.0 - tau * (1.0 / 5.0) * series
    series = 1.0 - tau * 0.25 * series
    series = 1.0 - tau * (1.0 / 3.0) * series
    series = 1.0 - tau * 0.5 * series
    return tl.where(tau < 0.25, tau * series, 1.0 - tl.exp(-tau))
