"""Terms that compare what rays see with the images (docs/method.md#photometric-losses)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.methods.devrf.volume_rendering import VoxelOutput


@dataclass(frozen=True)
class Prediction:
    """What the rays of a batch see, and the truth at their pixels."""

    output: VoxelOutput
    batch: RayBatch


def color_error(prediction: Prediction) -> Tensor:
    """Mean |Ĉ − C|² over rays and channels."""
    return torch.nn.functional.mse_loss(prediction.output.color, prediction.batch.color)


def per_sample_color(prediction: Prediction) -> Tensor:
    """(1/R) Σ_i sg(w_i) |c_i − C|²: each sample by itself should have the pixel's colour."""
    output = prediction.output
    truth = prediction.batch.color.index_select(0, output.samples.ray)
    error = (output.sample_color - truth).square().sum(dim=1)
    return (output.weight.detach() * error).sum() / len(prediction.batch.rays)


def background_entropy(prediction: Prediction) -> Tensor:
    """Mean −(p log p + (1 − p) log(1 − p)), p = T_end: a ray hits something or nothing."""
    p = prediction.output.transmittance.clamp(1e-6, 1 - 1e-6)
    return -(p * p.log() + (1 - p) * torch.log1p(-p)).mean()


def matte(prediction: Prediction) -> Tensor:
    """Mean (T_end − (1 − A))², A the images' alpha channel; 0 without one."""
    alpha = prediction.batch.alpha
    if alpha is None:
        return prediction.output.transmittance.new_zeros(())
    return (prediction.output.transmittance - (1 - alpha)).square().mean()


@torch.no_grad()
def visibility(prediction: Prediction) -> dict[str, Tensor]:
    """Means over rays, for the log: ``opacity`` 1 − T_end, and ``coverage`` A if there is one."""
    seen = {"opacity": 1 - prediction.output.transmittance.mean()}
    alpha = prediction.batch.alpha
    return seen if alpha is None else {**seen, "coverage": alpha.mean()}


PHOTOMETRIC_TERMS = {
    "color": color_error,
    "per_sample_color": per_sample_color,
    "entropy": background_entropy,
    "matte": matte,
}
