"""Errors of rendered geometry and motion."""

from __future__ import annotations

from torch import Tensor

# A pixel shows a surface where at least this much of its ray is stopped.
SOLID = 0.5


def depth_error(depth: Tensor, opacity: Tensor, truth: Tensor) -> float | None:
    """Mean absolute error of depths (H, W), in their unit.

    It is the mean over the pixels where both are finite and more than half of the ray is stopped:
    it measures displaced surfaces, not missing ones. None without such pixels.

    Args:
        depth: rendered distance along each pixel's ray.
        opacity: in [0, 1], the part of each ray that is stopped.
        truth: true distance, +inf where the ray hits nothing.
    """
    valid_mask = truth.isfinite() & depth.isfinite() & (opacity > SOLID)
    if not bool(valid_mask.any()):
        return None
    return float((depth[valid_mask] - truth[valid_mask]).abs().mean())


def end_point_error(flow: Tensor, truth: Tensor) -> float | None:
    """Mean Euclidean length of the differences of two flows (P, 2), in their unit.

    None if there are no vectors.
    """
    return float((flow - truth).norm(dim=-1).mean()) if len(truth) else None
