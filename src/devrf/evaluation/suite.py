"""Metrics of held-out views beside PSNR and SSIM."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from devrf.data.flow import previous_images
from devrf.errors import DevrfError, did_you_mean
from devrf.geometry.cameras import pixel_positions
from devrf.metrics.geometric import SOLID, depth_error, end_point_error
from devrf.metrics.image import ms_ssim, psnr_masked, ssim_masked, ssim_partial
from devrf.metrics.lpips import TRUNKS, Lpips, Network, load_lpips
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Views


@dataclass(frozen=True)
class MetricInput:
    """One held-out image, to be compared with the truth; on the host.

    Attributes:
        renderer: of the learned scene; None: the prediction is another program's.
        prediction: (H, W, 3) RGB in [0, 1]; the truth where pixels are not valid.
        truth: (H, W, 3) RGB in [0, 1].
        depth: (H, W) rendered distance along each pixel's ray, world units.
        opacity: (H, W) in [0, 1].
        lpips: the perceptual metric, or None without its weights.
    """

    renderer: Renderer | None
    views: Views
    index: int
    prediction: Tensor
    truth: Tensor
    depth: Tensor
    opacity: Tensor
    lpips: Lpips | None

    @property
    def mask(self) -> Tensor:
        """(H, W) bool, inside the alpha mask at valid pixels; nowhere True without one."""
        if not self.views.has_alpha:
            return torch.zeros(self.truth.shape[:2], dtype=torch.bool)
        inside = self.views.single(self.index).pixels[0, ..., 3].cpu() > 127
        return inside if self.valid_mask is None else inside & self.valid_mask

    @property
    def moving(self) -> Tensor:
        """(H, W) bool, valid pixels that show what moves; nowhere True where that is unknown."""
        mask = self.views.single(self.index).motion_mask
        if mask is None:
            return torch.zeros(self.truth.shape[:2], dtype=torch.bool)
        return mask[0].cpu() if self.valid_mask is None else mask[0].cpu() & self.valid_mask

    @property
    def valid_mask(self) -> Tensor | None:
        """(H, W) bool, the valid pixels; None: all of them."""
        return self.views.valid_mask_of(self.index)


def _ms_ssim(inputs: MetricInput) -> float | None:
    # Its coarse scales mix valid pixels with others.
    return ms_ssim(inputs.prediction, inputs.truth) if inputs.valid_mask is None else None


def _lpips(inputs: MetricInput, mask: Tensor | None, *, fill: bool = True) -> float | None:
    lpips = inputs.lpips
    return None if lpips is None else lpips(inputs.prediction, inputs.truth, mask, fill=fill)


def _ssim_covisible(inputs: MetricInput) -> float | None:
    valid_mask = inputs.valid_mask
    return None if valid_mask is None else ssim_partial(inputs.prediction, inputs.truth, valid_mask)


def _lpips_covisible(inputs: MetricInput) -> float | None:
    """DyCheck's mLPIPS: with AlexNet, and both images black where pixels are not valid."""
    valid_mask = inputs.valid_mask
    lpips = inputs.lpips
    if valid_mask is None or lpips is None or lpips.trunk is not TRUNKS["alex"]:
        return None
    mask = valid_mask[..., None]
    return lpips.forward(inputs.prediction * mask, inputs.truth * mask, valid_mask)


def _depth_error(inputs: MetricInput) -> float | None:
    truth = inputs.views.single(inputs.index).depth
    if truth is None:
        return None
    return depth_error(inputs.depth, inputs.opacity, truth[0].cpu())


# By name, in the order of tables; None where a view has no truth to compare with.
MEASURES: dict[str, Callable[[MetricInput], float | None]] = {
    "ms_ssim": _ms_ssim,
    "lpips": lambda inputs: _lpips(inputs, inputs.valid_mask),
    "psnr_masked": lambda inputs: psnr_masked(inputs.prediction, inputs.truth, inputs.mask),
    "ssim_masked": lambda inputs: ssim_masked(inputs.prediction, inputs.truth, inputs.mask),
    "lpips_masked": lambda inputs: _lpips(inputs, inputs.mask),
    "psnr_moving": lambda inputs: psnr_masked(inputs.prediction, inputs.truth, inputs.moving),
    "ssim_moving": lambda inputs: ssim_masked(inputs.prediction, inputs.truth, inputs.moving),
    "lpips_moving": lambda inputs: _lpips(inputs, inputs.moving, fill=False),
    "ssim_covisible": _ssim_covisible,
    "lpips_covisible": _lpips_covisible,
    "depth_error": _depth_error,
    "flow_error": lambda inputs: flow_error(inputs.renderer, inputs.views, inputs.index),
}
# Those of a learned field, which pictures alone do not have.
OF_FIELDS = ("depth_error", "flow_error")


@dataclass(frozen=True)
class Evaluation:
    """The choice of metrics, names of :data:`MEASURES`; see ``conf/evaluation/default.yaml``.

    Attributes:
        predictions: a folder of another program's pictures, which are scored in place of a run's
            (:mod:`devrf.evaluation.predictions`); None: the run is scored.
        program: the name of that program; None: the folder's.
        pictures: whether the pictures that are scored are written as PNG, too.
        motion_masks: a folder of masks of what moves in the held-out images, white, under names as
            of predictions; None: they are found (:mod:`devrf.evaluation.motion`).
    """

    metrics: Sequence[str] = tuple(MEASURES)
    lpips_network: Network = "vgg"
    lpips_weights: str | Path | None = None
    download: bool = False
    predictions: str | Path | None = None
    program: str | None = None
    pictures: bool = False
    motion_masks: str | Path | None = None

    def check(self) -> None:
        """Check that the metrics, the file of weights and the folders exist.

        Raises:
            DevrfError: an unknown metric, or no file or folder where one is given.
        """
        for name in self.metrics:
            if name not in MEASURES:
                raise DevrfError(
                    f"evaluation.metrics: no metric {name!r}; choose from {', '.join(MEASURES)}, "
                    "beside PSNR and SSIM, which are always measured"
                    f"{did_you_mean(name, MEASURES)}"
                )
        if self.predictions is None and self.program is not None:
            raise DevrfError(
                "evaluation.program: it names the program of evaluation.predictions, which are not "
                "given; give them, or leave it out"
            )
        if self.predictions is not None and not Path(self.predictions).exists():
            raise DevrfError(f"evaluation.predictions: no folder {self.predictions}; give another")
        if self.motion_masks is not None and not Path(self.motion_masks).is_dir():
            raise DevrfError(
                f"evaluation.motion_masks: no folder {self.motion_masks}; give another"
            )
        if self.lpips_weights is not None and not Path(self.lpips_weights).is_file():
            raise DevrfError(
                f"evaluation.lpips_weights: no file {self.lpips_weights}; give the weights of "
                f"{self.lpips_network}, or null to look in torch's cache"
            )

    def suite(self, device: torch.device) -> MetricSuite:
        """The metrics, ready to use; networks are on ``device``."""
        self.check()
        lpips = None
        if any(name.startswith("lpips") for name in self.metrics):
            lpips = load_lpips(self.lpips_network, self.lpips_weights, self.download)
        left_out = OF_FIELDS if self.predictions is not None else ()
        metrics = tuple(name for name in self.metrics if name not in left_out)
        return MetricSuite(metrics, lpips.to(device) if lpips else None)


@dataclass(frozen=True)
class MetricSuite:
    """The chosen metrics, ready to use.

    Attributes:
        metrics: names of :data:`MEASURES`.
        lpips: the perceptual metric, or None without its weights.
    """

    metrics: tuple[str, ...] = ()
    lpips: Lpips | None = None

    def scores(self, inputs: MetricInput) -> dict[str, float | None]:
        """Each metric by name; None where a view has no truth to compare with."""
        return {name: MEASURES[name](inputs) for name in self.metrics}


def flow_error(renderer: Renderer | None, views: Views, index: int) -> float | None:
    """Mean end-point error in pixels of image ``index``'s backward flow, where that is known.

    Rendered flow is 0 where opacity is below 0.5. None without flow or an earlier frame, or if the
    method's views have no motion, or nothing is rendered.
    """
    if renderer is None or views.flow is None:
        return None
    before = int(previous_images(views)[index])
    # On the raster of all images: flow beside an image is not valid.
    flat = views.flow.valid[index].flatten().nonzero()[:, 0]
    if before == index or len(flat) == 0:
        return None
    pixels = pixel_positions(flat, views.width)
    rays = views.cameras.rays(torch.full_like(flat, index), pixels)
    time = float(views.times[index])
    earlier = float(views.times[before])
    flow = renderer.induced_flow(rays, pixels, views.cameras[[before]], time, earlier)
    if flow is None:
        return None
    mean, mass = flow
    rendered = torch.where(mass[:, None] > SOLID, mean, torch.zeros_like(mean)).cpu()
    return end_point_error(rendered, views.flow.vectors[index].view(-1, 2)[flat])
