"""Renders held-out views and compares them with the truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from devrf.evaluation.suite import MetricInput, MetricSuite
from devrf.metrics.image import psnr, psnr_masked, ssim, ssim_masked, ssim_within
from devrf.rendering.output import RenderedImage
from devrf.rendering.renderer import Renderer, points_at_depth
from devrf.scenes.scene import Background, Views, background_value, on_background


@dataclass(frozen=True)
class HeldOutView:
    """A held-out image, a prediction of it, and metrics over the valid pixels.

    Attributes:
        truth: (H, W, 3) RGB in [0, 1].
        prediction: (H, W, 3) RGB in [0, 1].
        psnr: dB.
        rest_pose_psnr: PSNR in dB of the canonical scene, in place of the prediction; None of
            another program's picture.
        further: other metrics by name; None where a view has no truth to compare with.
        compared: (H, W, 3) RGB in [0, 1], the prediction at valid pixels, else the truth.
        depth: (H, W) mean distance of the visible samples, in the space of the fields.
        opacity: (H, W) in [0, 1], 1 − transmittance; 0 where depth is unknown.
    """

    name: str
    time: float
    truth: Tensor
    prediction: Tensor
    psnr: float
    ssim: float
    rest_pose_psnr: float | None = None
    further: dict[str, float | None] = field(default_factory=dict)
    compared: Tensor = field(kw_only=True)
    depth: Tensor = field(kw_only=True)
    opacity: Tensor = field(kw_only=True)

    @property
    def scores(self) -> dict[str, float | None]:
        """Every metric by name."""
        rest = self.rest_pose_psnr
        of_rest = {} if rest is None else {"rest_pose_psnr": rest}
        return {"psnr": self.psnr, "ssim": self.ssim, **of_rest, **self.further}


def compared_with_truth(
    color: Tensor, views: Views, index: int, background: Background
) -> HeldOutView:
    """Compare a picture (H, W, 3) in [0, 1] of image ``index`` of held-out ``views`` with it.

    Only valid pixels are compared, for SSIM in windows of valid pixels alone. For other metrics
    over neighbourhoods the prediction at other pixels is the truth. The prediction gets the image's
    own exposure first, if a part of the image is there to estimate it. All is on the host.
    """
    truth = truth_image(views, index, background)
    prediction = exposed(color, truth, views, index)
    valid_mask = views.valid_mask_of(index)
    compared = compare(prediction, truth, valid_mask)
    return HeldOutView(
        name=views.names[index],
        time=float(views.times[index]),
        truth=truth,
        prediction=prediction,
        psnr=_psnr(compared, truth, valid_mask),
        ssim=_ssim(compared, truth, valid_mask),
        compared=compared,
        depth=torch.zeros(truth.shape[:2]),
        opacity=torch.zeros(truth.shape[:2]),
    )


def score(
    renderer: Renderer,
    views: Views,
    index: int,
    background: Background,
    suite: MetricSuite | None = None,
    *,
    time: float | None = None,
    rest_pose_psnr: float | None = None,
) -> HeldOutView:
    """Render image ``index`` of held-out ``views`` and compare it as :func:`compared_with_truth`.

    ``views`` are on the host. ``suite`` has metrics beside PSNR and SSIM. ``time`` in [0, 1] is
    rendered; None: the image's own. ``rest_pose_psnr`` is the image's, if it
    was computed before; None: the canonical scene is rendered, too.
    """
    time = float(views.times[index]) if time is None else time
    behind = background_value(background)
    camera = views.cameras.single(index)
    rendered = renderer.view(camera, 0, time, behind)
    shape = (camera.height, camera.width)
    view = compared_with_truth(_color(rendered, shape), views, index, background)
    if rest_pose_psnr is None:
        rest_pose_psnr = view.psnr
        if not renderer.at(time).at_rest:
            valid_mask = views.valid_mask_of(index)
            canonical = _color(renderer.view(camera, 0, 0.0, behind), shape)
            canonical = exposed(canonical, view.truth, views, index)
            canonical = compare(canonical, view.truth, valid_mask)
            rest_pose_psnr = _psnr(canonical, view.truth, valid_mask)
    view = replace(
        view,
        rest_pose_psnr=rest_pose_psnr,
        depth=rendered.depth.cpu().view(shape),
        opacity=rendered.opacity.cpu().view(shape),
    )
    if suite is None or not suite.metrics:
        return view
    rays = camera.image_rays(0)
    points = points_at_depth(renderer.model.space, rays, rendered.depth.cpu())
    distance = (points - rays.origins).norm(dim=1).view(shape)
    inputs = MetricInput(
        renderer, views, index, view.compared, view.truth, distance, view.opacity, suite.lpips
    )
    return replace(view, further=suite.scores(inputs))


def compare(prediction: Tensor, truth: Tensor, valid_mask: Tensor | None) -> Tensor:
    """The prediction (H, W, 3) of a held-out image; the truth where pixels are not valid."""
    if valid_mask is None:
        return prediction
    return torch.where(valid_mask[..., None], prediction, truth)


# Values between these determine a gain; gains are limited to this factor and its inverse.
GAIN_VALUES = (0.04, 0.97)
LARGEST_GAIN = 4.0


def exposed(prediction: Tensor, truth: Tensor, views: Views, index: int) -> Tensor:
    """The prediction, each channel times the gain that brings it nearest to the truth.

    Args:
        prediction: (H, W, 3) RGB in [0, 1] of image ``index`` of held-out ``views``.
        truth: the same.
        views: those with an ``exposure_mask`` have exposures of their own; else nothing changes.
        index: the image's.
    """
    if views.exposure_mask is None:
        return prediction
    low, high = GAIN_VALUES
    within = (torch.minimum(prediction, truth) > low) & (torch.maximum(prediction, truth) < high)
    height, width = truth.shape[:2]
    used = views.exposure_mask[index, :height, :width].cpu()[..., None] & within
    squares = (prediction.square() * used).sum(dim=(0, 1))
    gain = (prediction * truth * used).sum(dim=(0, 1)) / squares.clamp(min=1e-6)
    gain = torch.where(squares > 0, gain, 1.0).clamp(1 / LARGEST_GAIN, LARGEST_GAIN)
    return (prediction * gain).clamp(0, 1)


def _psnr(compared: Tensor, truth: Tensor, valid_mask: Tensor | None) -> float:
    # Readers refuse an empty mask.
    value = None if valid_mask is None else psnr_masked(compared, truth, valid_mask)
    return psnr(compared, truth) if value is None else value


def _ssim(compared: Tensor, truth: Tensor, valid_mask: Tensor | None) -> float:
    # If no window has valid pixels alone, those centred on valid pixels count; if no such window is
    # inside the image, all windows count.
    if valid_mask is not None:
        for measure in (ssim_within, ssim_masked):
            value = measure(compared, truth, valid_mask)
            if value is not None:
                return value
    return ssim(compared, truth)


def truth_image(views: Views, index: int, background: Background) -> Tensor:
    """A held-out image (H, W, 3) in [0, 1], of its own size, on the background.

    A random background is white here.
    """
    return on_background(views.single(index).pixels[0], background_value(background))


def _color(image: RenderedImage, shape: tuple[int, int]) -> Tensor:
    return image.color.view(*shape, 3).clamp(0, 1).cpu()
