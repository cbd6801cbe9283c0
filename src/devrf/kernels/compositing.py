"""Colours of rays from those of their samples; a thread follows one ray.

See docs/method.md#compositing. The loss that is learned from has its own gradient
(:mod:`devrf.kernels.photometric`); that of colours is for other terms.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from devrf.kernels.adjoint import with_adjoint
from devrf.kernels.runtime import is_supported, launch
from devrf.ops import compositing as definition
from devrf.ops.march import Samples


def composite_colors(samples: Samples, color: Tensor, background: Tensor) -> Tensor:
    """As :func:`devrf.ops.compositing.composite_colors` of samples of a march."""
    weight, end = samples.weight, samples.transmittance
    if not is_supported(color):
        return definition.composite_colors(weight, color, samples.ray, end, background)
    given = [each.detach().contiguous() for each in (weight, color, end, background)]
    image = torch.empty(len(end), 3, device=color.device)
    inputs = [samples.stop, *given[:3], given[3].view(-1, 3), image]
    launch(composite_kernel, len(end), inputs, color.device)

    def adjoint(gradient: Tensor) -> tuple[Tensor | None, ...]:
        of_samples = gradient.index_select(0, samples.ray)
        of_weight = (of_samples * color).sum(dim=1)
        of_end = (gradient * background).sum(dim=1)
        of_background = None
        if background.requires_grad:
            of_background = (end[:, None] * gradient).sum_to_size(background.shape)
        return of_weight, of_samples * weight[:, None], of_end, of_background

    return with_adjoint((image,), (weight, color, end, background), adjoint)[0]


@wp.func
def first_of(stops: wp.array(dtype=wp.int64), ray: int):
    """A ray's first sample."""
    if ray == 0:
        return 0
    return int(stops[ray - 1])


@wp.func
def behind(background: wp.array(dtype=wp.vec3), ray: int):
    """The colour behind a ray: its own, or that of all."""
    return background[wp.min(ray, background.shape[0] - 1)]


@wp.kernel(module="unique", enable_backward=False)
def composite_kernel(
    first: int,
    stops: wp.array(dtype=wp.int64),
    weight: wp.array(dtype=float),
    color: wp.array(dtype=wp.vec3),
    transmittance: wp.array(dtype=float),
    background: wp.array(dtype=wp.vec3),
    image: wp.array(dtype=wp.vec3),
):
    """Ĉ = Σ w_i c_i + T_end · C_background."""
    ray = first + wp.tid()
    total = wp.vec3()
    for k in range(first_of(stops, ray), int(stops[ray])):
        total += weight[k] * color[k]
    image[ray] = total + transmittance[ray] * behind(background, ray)
