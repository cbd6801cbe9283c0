"""The elastic loss: a warp should turn things, not stretch them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.func import jvp, vmap

from devrf.ops.compositing import firsts, running_sum

# The least squared singular value, so that log² stays finite.
LEAST = 1e-12
# c: strains above it count less and less.
SCALE = 0.03


def jacobians(warp: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """J = ∂x′/∂x (S, 3, 3) at points (S, 3) of a warp that moves each for itself."""

    def along(direction: Tensor) -> Tensor:
        change: Tensor = jvp(warp, (points,), (direction.expand_as(points),))[1]
        return change

    columns = torch.eye(3, dtype=points.dtype, device=points.device)
    matrices: Tensor = vmap(along, out_dims=-1)(columns)
    return matrices


def strain(jacobian: Tensor) -> Tensor:
    """Σ_j log² s_j (S,) of the singular values s of J (S, 3, 3): 0 for a rotation.

    They are the roots of the eigenvalues of JᵀJ, so this is ¼ Σ log² λ_j, with finite gradients
    also where eigenvalues are equal.
    """
    square = jacobian.transpose(-1, -2) @ jacobian
    eigenvalues = torch.linalg.eigvalsh(square).clamp(min=LEAST)
    squares: Tensor = eigenvalues.log().square()
    return squares.sum(dim=-1) / 4


def robust(square: Tensor, scale: float) -> Tensor:
    """ρ(s²; c) = 2u / (u + 4), u = s² / c² (Geman–McClure): from 0 to 2.

    Args:
        square: s² ≥ 0 of any shape.
        scale: c.
    """
    u = square / scale**2
    return 2 * u / (u + 4)


def drawn(weight: Tensor, ray: Tensor, rays: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """One sample of each of some rays, drawn in proportion to its weight.

    A sum over a ray's samples Σ w_i f_i is estimated without bias by (Σ w_i) f of the one drawn.

    Args:
        weight: (S,) w ≥ 0.
        ray: (S,) int64, ascending: the ray of each sample.
        rays: (K,) int64, the rays' numbers.
        count: the number of rays.

    Returns:
        The samples (M,) int64 of those of the rays that have any weight, and the rays' Σ w_i (M,).
    """
    reached = running_sum(weight)
    edges = firsts(ray, count)
    start = reached[edges[rays]]
    mass = reached[edges[rays + 1]] - start
    visible = (mass > 0).nonzero()[:, 0]
    mass = mass[visible]
    wanted = start[visible] + torch.rand_like(mass) * mass
    picked = torch.searchsorted(reached, wanted, right=True) - 1
    return picked.clamp(max=max(len(weight) - 1, 0)), mass.to(weight.dtype)
