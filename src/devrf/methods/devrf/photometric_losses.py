"""Terms that compare what rays see with the images (docs/method.md#photometric-losses)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.methods.devrf.volume_rendering import VoxelOutput


@dataclass(frozen=True)
class Prediction:
    """What was rendered, beside what should have been.

    Attributes:
        output: what the rays see.
        batch: the rays and the truth at their pixels.
    """

    output: VoxelOutput
    batch: RayBatch


def color_error(prediction: Prediction) -> Tensor:
    """Mean squared colour error over rays and channels."""
    return torch.nn.functional.mse_loss(prediction.output.color, prediction.batch.color)


def per_sample_color(prediction: Prediction) -> Tensor:
    """Σ_i sg(w_i)·|c_i − C|² / R: each sample alone should have the pixel's colour."""
    output = prediction.output
    truth = prediction.batch.color.index_select(0, output.samples.ray)
    error = (output.sample_color - truth).square().sum(dim=1)
    return (output.weight.detach() * error).sum() / len(prediction.batch.rays)


def background_entropy(prediction: Prediction) -> Tensor:
    """Mean of −(p log p + (1 − p) log(1 − p)), p = T_end: a ray hits something or nothing."""
    p = prediction.output.transmittance.clamp(1e-6, 1 - 1e-6)
    return -(p * p.log() + (1 - p) * torch.log1p(-p)).mean()


def matte(prediction: Prediction) -> Tensor:
    """Mean of (T_end − (1 − alpha))²: what is left of a ray is what the matte lets through.

    Zero where the images have no matte.
    """
    alpha = prediction.batch.alpha
    if alpha is None:
        return prediction.output.transmittance.new_zeros(())
    return (prediction.output.transmittance - (1 - alpha)).square().mean()


@torch.no_grad()
def visibility(prediction: Prediction) -> dict[str, Tensor]:
    """How much is seen, and how much should be: means over rays in [0, 1], no part of the loss.

    ``opacity`` is 1 − T_end; ``coverage`` the matte, for images that have one.
    """
    seen = {"opacity": 1 - prediction.output.transmittance.mean()}
    alpha = prediction.batch.alpha
    return seen if alpha is None else {**seen, "coverage": alpha.mean()}


PHOTOMETRIC_TERMS = {
    "color": color_error,
    "per_sample_color": per_sample_color,
    "entropy": background_entropy,
    "matte": matte,
}
