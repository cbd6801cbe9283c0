"""What is measured on a held-out view beside PSNR and SSIM."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.evaluation.held_out_flow import flow_error
from devrf.methods.devrf.renderer import Renderer
from devrf.metrics.geometric import depth_error
from devrf.metrics.image import ms_ssim
from devrf.metrics.masked import psnr_masked, ssim_masked
from devrf.metrics.perceptual import Lpips
from devrf.metrics.pretrained import Network, load_lpips
from devrf.scenes.scene import Views


@dataclass(frozen=True)
class MetricInput:
    """What is compared with the truth: one held-out image, on the host.

    Attributes:
        player: shows what was learned.
        views: the held-out views.
        index: which of them.
        prediction: (H, W, 3) RGB in [0, 1]; the truth where pixels do not count.
        truth: (H, W, 3) RGB in [0, 1].
        depth: (H, W) rendered distance along each pixel's ray, world units.
        opacity: (H, W) in [0, 1].
        lpips: the perceptual metric, or None where it cannot be had.
    """

    player: Renderer
    views: Views
    index: int
    prediction: Tensor
    truth: Tensor
    depth: Tensor
    opacity: Tensor
    lpips: Lpips | None

    @property
    def mask(self) -> Tensor:
        """(H, W) bool, inside the matte where pixels count; nowhere True of images without one."""
        pixels = self.views.pixels[self.index]
        if not self.views.has_alpha:
            return torch.zeros(pixels.shape[:2], dtype=torch.bool)
        inside = pixels[..., 3].cpu() > 127
        return inside if self.valid_mask is None else inside & self.valid_mask

    @property
    def valid_mask(self) -> Tensor | None:
        """(H, W) bool, the pixels that count; None: all of them."""
        return self.views.valid_mask_of(self.index)


def _ms_ssim(sight: MetricInput) -> float | None:
    # Its coarse scales mix pixels that count with others.
    return ms_ssim(sight.prediction, sight.truth) if sight.valid_mask is None else None


def _lpips(sight: MetricInput) -> float | None:
    if sight.lpips is None:
        return None
    if sight.valid_mask is not None:
        return sight.lpips.inside(sight.prediction, sight.truth, sight.valid_mask)
    whole: float | None = sight.lpips(sight.prediction, sight.truth)
    return whole


def _lpips_masked(sight: MetricInput) -> float | None:
    inside = sight.lpips.inside if sight.lpips else None
    return inside(sight.prediction, sight.truth, sight.mask) if inside else None


def _depth_error(sight: MetricInput) -> float | None:
    truth = sight.views.depth
    if truth is None:
        return None
    return depth_error(sight.depth, sight.opacity, truth[sight.index].cpu())


# By name, in the order of tables; None where a view has nothing to compare with.
MEASURES: dict[str, Callable[[MetricInput], float | None]] = {
    "ms_ssim": _ms_ssim,
    "lpips": _lpips,
    "psnr_masked": lambda sight: psnr_masked(sight.prediction, sight.truth, sight.mask),
    "ssim_masked": lambda sight: ssim_masked(sight.prediction, sight.truth, sight.mask),
    "lpips_masked": _lpips_masked,
    "depth_error": _depth_error,
    "flow_error": lambda sight: flow_error(sight.player, sight.views, sight.index),
}


@dataclass(frozen=True)
class Evaluation:
    """What is measured on held-out views beside PSNR and SSIM.

    Attributes:
        metrics: names of :data:`MEASURES`; fewer are quicker.
        lpips_network: the network behind LPIPS.
        lpips_weights: a file with that network's weights; None looks in torch's cache.
        download: whether weights that are nowhere to be found may be downloaded.
    """

    metrics: Sequence[str] = tuple(MEASURES)
    lpips_network: Network = "vgg"
    lpips_weights: str | Path | None = None
    download: bool = False

    def check(self) -> None:
        """See that what is asked for exists.

        Raises:
            DevrfError: an unknown metric, or no file of weights where one is given.
        """
        for name in self.metrics:
            if name not in MEASURES:
                raise DevrfError(
                    f"evaluation.metrics: no metric {name!r}; choose from {', '.join(MEASURES)}"
                )
        if self.lpips_weights is not None and not Path(self.lpips_weights).is_file():
            raise DevrfError(
                f"evaluation.lpips_weights: no file {self.lpips_weights}; give the weights of "
                f"{self.lpips_network}, or null to look in torch's cache"
            )

    def judge(self, device: torch.device) -> MetricSuite:
        """The metrics, ready to use; networks are on ``device``."""
        self.check()
        lpips = None
        if any(name.startswith("lpips") for name in self.metrics):
            lpips = load_lpips(self.lpips_network, self.lpips_weights, self.download)
        return MetricSuite(tuple(self.metrics), lpips.to(device) if lpips else None)


@dataclass(frozen=True)
class MetricSuite:
    """The chosen metrics, ready to use.

    Attributes:
        metrics: names of :data:`MEASURES`.
        lpips: the perceptual metric, or None where it cannot be had.
    """

    metrics: tuple[str, ...] = ()
    lpips: Lpips | None = None

    def scores(self, sight: MetricInput) -> dict[str, float | None]:
        """Each metric of one sight; None where there is nothing to compare with."""
        return {name: MEASURES[name](sight) for name in self.metrics}
