"""From points at one time to optical depths in canonical space, in one pass."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.ops.corners import Corners, shape_of, to_grid
from devrf.ops.trilinear import interpolate


def warped_depth(
    points: Tensor,
    density: Tensor,
    slices: Sequence[Tensor] = (),
    weight: float = 0.0,
    *,
    box: Corners,
    shift: float,
    delta: float,
    density_gradient: Tensor | None = None,
    slice_gradients: Sequence[Tensor | None] = (),
) -> tuple[Tensor, Tensor]:
    """Canonical positions of points, and optical depths there.

    ``q = x + Δ(x)`` and ``τ = softplus(v(q) + b)·δ``, where Δ and v are trilinear, and
    ``Δ = (1 − w)·Δ_0 + w·Δ_1`` between two frames. All grids have their corners on one box;
    outside it they continue with their values at the border.

    Args:
        points: (M, 3) x in the box's units. They get no gradient.
        density: (X, Y, Z, 1) raw densities v.
        slices: displacements in the box's units, (X', Y', Z', 3) each: none for the rest state,
            one frame, or the two frames around the time of the points.
        weight: w of the second frame, in [0, 1].
        box: the box of the grids.
        shift: b, added to a raw density.
        delta: δ, the length of a step in base voxels.
        density_gradient: as ``gradient`` of :func:`~devrf.ops.trilinear.interpolate`.
        slice_gradients: the same for each of ``slices``, or None; empty for none at all.

    Returns:
        q (M, 3) and τ (M,), differentiable once in ``density`` and ``slices``; the gradient of τ
        reaches the slices through the slope of the density at q.

    Raises:
        DevrfError: more than two slices, or two of different shapes.
    """
    if len(slices) > 2 or len({frame.shape for frame in slices}) > 1:
        shapes = ", ".join(str(tuple(frame.shape)) for frame in slices)
        raise DevrfError(f"warp: expected at most two slices of one shape, not {shapes}")
    into: list[Tensor | None] = [*slice_gradients] or [None] * len(slices)
    q = points = points.detach()
    if slices:
        coords = to_grid(points, box, shape_of(slices[0]))
        moves = [
            interpolate(frame, coords, gradient=buffer)
            for frame, buffer in zip(slices, into, strict=True)
        ]
        q = points + (moves[0] if len(moves) == 1 else moves[0].lerp(moves[1], weight))
    at = to_grid(q, box, shape_of(density))
    raw = interpolate(density, at, gradient=density_gradient)[:, 0]
    return q, torch.nn.functional.softplus(raw + shift) * delta
