"""Terms that constrain the deformation field (docs/method.md#motion-losses)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.space import WORLD, Space
from devrf.methods.devrf.photometric_losses import PHOTOMETRIC_TERMS, Prediction
from devrf.methods.devrf.volume_rendering import Warp


@dataclass(frozen=True)
class MotionPrediction(Prediction):
    """A prediction through the warp of one frame t, with what the motion terms need.

    Attributes:
        unwarp: canonical points q (M, 3) → q + Δ_f(q, t).
        unwarp_previous: q → q + Δ_f(q, t − 1), frozen.
        cameras: the cameras of the images that the batch was drawn from.
        previous_image: (N,) int64, for each image the one that its flow leads to (the same view
            one frame earlier), or the image itself where there is none.
        space: the space that points are in.
    """

    unwarp: Warp
    unwarp_previous: Warp
    cameras: Cameras
    previous_image: Tensor
    space: Space = WORLD


def cycle(prediction: MotionPrediction) -> Tensor:
    """L_cycle = mean_i ½ |x_i − (q_i + Δ_f(q_i, t))|² (docs/method.md#cycle)."""
    output = prediction.output
    returned = prediction.unwarp(output.canonical)
    missed = 0.5 * (output.samples.points - returned).square().sum(dim=1)
    return output.mean_over_samples(missed)


def flow(prediction: MotionPrediction) -> Tensor:
    """L_flow = (1/M) Σ_i w_i m_i |φ_i − φ_i^observed|₁ in pixels (docs/method.md#flow).

    M is the number of rays whose flow is valid; 0 without observed flow.
    """
    batch, output = prediction.batch, prediction.output
    if batch.flow is None or batch.flow_valid is None:
        return output.canonical.new_zeros(())
    ray, canonical, weight = output.on_rays(batch.flow_valid)
    induced = induced_flow(
        canonical,
        prediction.unwarp_previous,
        prediction.cameras,
        prediction.previous_image[batch.image[ray]],
        batch.pixel[ray],
        prediction.space,
    )
    error = (induced - batch.flow[ray]).abs().sum(dim=1)
    return (weight * error).sum() / batch.flow_valid.sum().clamp(min=1)


def induced_flow(
    canonical: Tensor,
    unwarp_previous: Warp,
    cameras: Cameras,
    camera: Tensor,
    pixel: Tensor,
    space: Space = WORLD,
) -> Tensor:
    """φ = π(q + Δ_f(q, t − 1)) − u (M, 2) in pixels, the flow that the motion implies.

    Args:
        canonical: (M, 3) canonical positions q.
        unwarp_previous: q → q + Δ_f(q, t − 1).
        cameras: all cameras.
        camera: (M,) int64, the camera π that took the earlier frame.
        pixel: (M, 2) u, where the points are seen now: x, y in pixels.
        space: the space that the points are in.
    """
    position, _ = cameras.project(camera, space.to_world(unwarp_previous(canonical)))
    return position - pixel


def total_variation_weight(weight: float, side: int, rays: int) -> float:
    """ω · (side / 128) / (6R): factor of Σ clamp(v − v', −1, 1) (docs/method.md#total-variation).

    The optimiser adds this gradient, not autograd.

    Args:
        weight: ω, the term's weight.
        side: max(N_x, N_y, N_z) of the grid.
        rays: R, the rays of a batch.
    """
    return weight * (side / 128) / rays / 6


MOTION_TERMS = {
    **{("render" if name == "color" else name): term for name, term in PHOTOMETRIC_TERMS.items()},
    "cycle": cycle,
    "flow": flow,
}
