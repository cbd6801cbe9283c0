"""Colours of rays from those of their samples, and the adjoint; a thread follows one ray.

See docs/method.md#compositing.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.kernels.runtime import is_supported, launch
from devrf.ops import compositing as definition
from devrf.ops.march import Samples


def composite_colors(samples: Samples, color: Tensor, background: Tensor) -> Tensor:
    """As :func:`devrf.ops.compositing.composite_colors` of samples of a march."""
    weight, end = samples.weight, samples.transmittance
    if not is_supported(color):
        return definition.composite_colors(weight, color, samples.ray, end, background)
    image: Tensor = _Composite.apply(weight, color, end, background, samples.stop)  # type: ignore[no-untyped-call]
    return image


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, weight: Tensor, color: Tensor, end: Tensor, background: Tensor, stop: Tensor
    ) -> Tensor:
        behind = background.contiguous().view(-1, 3)
        given = [stop, weight.contiguous(), color.contiguous(), end.contiguous(), behind]
        ctx.save_for_backward(*given)
        image = torch.empty(len(end), 3, device=color.device)
        launch(composite_kernel, len(end), [*given, image], color.device)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        given = ctx.saved_tensors
        results = [torch.empty_like(each) for each in given[1:4]]
        # One background for all rays is never learned.
        of_background = torch.empty_like(given[4]) if ctx.needs_input_grad[3] else None
        behind = gradient.new_empty(0, 3) if of_background is None else of_background
        inputs = [*given, gradient.contiguous(), *results, behind]
        launch(adjoint_kernel, len(gradient), inputs, gradient.device)
        return *results, of_background, None


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


@wp.kernel(module="unique", enable_backward=False)
def adjoint_kernel(
    first: int,
    stops: wp.array(dtype=wp.int64),
    weight: wp.array(dtype=float),
    color: wp.array(dtype=wp.vec3),
    transmittance: wp.array(dtype=float),
    background: wp.array(dtype=wp.vec3),
    given: wp.array(dtype=wp.vec3),
    of_weight: wp.array(dtype=float),
    of_color: wp.array(dtype=wp.vec3),
    of_transmittance: wp.array(dtype=float),
    of_background: wp.array(dtype=wp.vec3),
):
    """The gradients of the arguments of :func:`composite_kernel` from that of the image."""
    ray = first + wp.tid()
    g = given[ray]
    for k in range(first_of(stops, ray), int(stops[ray])):
        of_weight[k] = wp.dot(g, color[k])
        of_color[k] = weight[k] * g
    of_transmittance[ray] = wp.dot(g, behind(background, ray))
    if of_background.shape[0] > 0:
        of_background[ray] = transmittance[ray] * g
