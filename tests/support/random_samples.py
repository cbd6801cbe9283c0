"""Random samples of rays, as a march gives them."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.ops.compositing import firsts
from devrf.ops.march import Samples


def samples_of(ray: Tensor, rays: int, rng: torch.Generator) -> Samples:
    """Samples of rays, some of which have none, with random weights and transmittances."""
    weight = torch.rand(len(ray), generator=rng)
    end = torch.rand(rays, generator=rng)
    points = torch.rand(len(ray), 3, generator=rng)
    stop = firsts(ray, rays)[1:]
    return Samples(ray, weight, points, points.clone(), weight, end, torch.zeros(rays), stop)
