"""Terms that tie the deformation field together (docs/method.md#motion-losses)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.space import WORLD, Space
from devrf.methods.devrf.photometric_losses import PHOTOMETRIC_TERMS, Prediction
from devrf.methods.devrf.volume_rendering import Warp


@dataclass(frozen=True)
class MotionPrediction(Prediction):
    """What was rendered through the warp of one frame, with what the motion terms need.

    Attributes:
        unwarp: canonical points (M, 3) → their positions at this frame, q + Δ_f(q, t).
        unwarp_previous: the same for the frame before, frozen.
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
    """Mean over samples of ½ |x − (q + Δ_f(q, t))|²: there and back again."""
    output = prediction.output
    returned = prediction.unwarp(output.canonical)
    missed = 0.5 * (output.samples.points - returned).square().sum(dim=1)
    return output.mean_over_samples(missed)


def flow(prediction: MotionPrediction) -> Tensor:
    """L1 between the induced and the observed backward flow, weighted by w_i and the mask.

    Samples go back to canonical space, forward to the frame before, and onto that frame's
    image; that pixel minus the sample's own is the induced flow. Pixels; the mean over the rays
    whose flow is valid; zero without observed flow.
    """
    batch, output = prediction.batch, prediction.output
    if batch.flow is None or batch.flow_valid is None:
        return output.canonical.new_zeros(())
    seen = output.on_rays(batch.flow_valid)
    induced = induced_flow(
        seen.canonical,
        prediction.unwarp_previous,
        prediction.cameras,
        prediction.previous_image[batch.image[seen.ray]],
        batch.pixel[seen.ray],
        prediction.space,
    )
    observed = batch.flow[seen.ray]
    error = (induced - observed).abs().sum(dim=1)
    return (seen.weight * error).sum() / batch.flow_valid.sum().clamp(min=1)


def induced_flow(
    canonical: Tensor,
    unwarp_previous: Warp,
    cameras: Cameras,
    camera: Tensor,
    pixel: Tensor,
    space: Space = WORLD,
) -> Tensor:
    """The optical flow (M, 2) that the motion fields imply for canonical points.

    Args:
        canonical: (M, 3) canonical positions of what is seen at ``pixel``.
        unwarp_previous: canonical points → their positions one frame earlier.
        cameras: all cameras.
        camera: (M,) the camera that took the earlier frame.
        pixel: (M, 2) where the points are seen now, x, y in pixels.
        space: the space that the points are in; they are projected from the world.
    """
    position, _ = cameras.project(camera, space.to_world(unwarp_previous(canonical)))
    return position - pixel


MOTION_TERMS = {
    **{("render" if name == "color" else name): term for name, term in PHOTOMETRIC_TERMS.items()},
    "cycle": cycle,
    "flow": flow,
}
