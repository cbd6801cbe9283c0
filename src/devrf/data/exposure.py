"""The exposure of each image of a film: found along the motion, and made equal.

A phone's gain and white balance follow what it sees. What image k of a film shows is in image j,
1, 4 or 16 places before, where optical flow leads. Over pixels of which this is true
s(k, j) = log(Σ C(k) / Σ C(j)), for each channel, is the step that the exposure θ = log(gain) has
made. All θ together solve

    min Σ_{k,j} |θ(k) − θ(j) − s(k, j)|² + 10⁻⁴ Σ_k |θ(k)|²

and images to learn from are divided by their gains. This is done before anything is learned: every
method learns from the same images, and no checkpoint holds a gain.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from devrf.scenes.optical_flow import LEAST_SIDE, Estimator, estimator, flow_between
from devrf.scenes.reader import Exposure
from devrf.scenes.resampling import look_up_pixels, shrink_pixels
from devrf.scenes.scene import Capture, Scene, Views

log = logging.getLogger(__name__)

# Exposures that differ by less than this, as log(gain), are left alone: content does as much.
DRIFT = 0.15
# At most so many images are compared.
MOST = 100
# How much all exposures are drawn to their mean.
WEIGHT = 1e-4
# Grey levels at which a channel still tells a ratio.
DARKEST, BRIGHTEST = 12, 248
# Pixels whose log ratio is farther than this from the median show something else.
SAME = 0.15
# Images so many places apart are compared: steps that add up to a long way are not exact.
APART = (1, 4, 16)
# The share of pixels that flow has to follow, and the share of the pairs of images in which it has.
FOLLOWED = 0.15
PAIRS = 0.9


def with_equal_exposure(scene: Scene, choice: Exposure) -> Scene:
    """The scene with training images of one exposure, where one camera has filmed it.

    Of held-out images the right halves are scored, once the left halves have told their gain.

    Args:
        scene: as its reader gave it.
        choice: ``auto`` makes exposures equal that differ by more than a seventh, ``equal`` all;
            ``none`` changes nothing.
    """
    train = scene.dynamic.train
    # Without a static set the images up to a time stand in for it.
    alone = {*scene.static.train.names} <= {*train.names} and train.by_moving_camera
    if choice == "none" or not alone or not scene.moves or train.cut_out:
        return scene
    theta = exposures(train)
    drift = 0.0 if theta is None else float((theta.amax(dim=0) - theta.amin(dim=0)).max())
    if theta is None or (choice == "auto" and drift < DRIFT):
        return scene
    log.info(
        "%s: exposure changes by %.0f %% and is made equal; held-out images are scored on their "
        "right halves, with gains that their left ones tell (data.exposure=none: as they are)",
        scene.name,
        100 * math.expm1(drift),
    )
    gains = dict(zip(train.names, (-theta).exp(), strict=True))

    def changed(capture: Capture) -> Capture:
        held_out = capture.mapped(_halved)
        return replace(held_out, train=_exposed(capture.train, gains))

    film = changed(scene.dynamic)
    rest = film if scene.static.train is train else changed(scene.static)
    return replace(scene, static=rest, dynamic=film)


def _exposed(views: Views, gains: Mapping[str, Tensor]) -> Views:
    """The views with each image's red, green and blue times its gains (3,).

    What an image shows at its brightest, and too bright, tells no colour: it is not valid.
    """
    pixels = views.pixels.clone()
    told = torch.ones_like(pixels[..., 0], dtype=torch.bool)
    for image, mask, name in zip(pixels, told, views.names, strict=True):
        gain = gains[name]
        mask &= ~((image[..., :3] > BRIGHTEST) & (gain < 1)).any(dim=-1)
        image[..., :3] = (image[..., :3] * gain).round().clamp(0, 255).to(torch.uint8)
    valid = told if views.valid_mask is None else views.valid_mask & told
    return replace(views, pixels=pixels, valid_mask=valid)


def exposures(views: Views) -> Tensor | None:
    """(N, 3) log(gain) of each image's red, green and blue, of mean 0, in the order of the views.

    None where flow follows too little: a camera that leaps, or too few pixels in common.

    Args:
        views: N images that one moving camera took one after another.
    """
    order = views.times.argsort(stable=True)
    spread = order[:: math.ceil(len(views) / MOST)]
    film = _small(views[spread])
    between = estimator("dis")
    steps: dict[tuple[int, int], Tensor] = {}
    for apart in APART:
        for k in range(apart, len(film)):
            there = _step(film, k, k - apart, between)
            back = _step(film, k - apart, k, between)
            if there is not None and back is not None:
                # What one image is blurred by, looked up in between its pixels, cancels out.
                steps[k, k - apart] = (there - back) / 2
        if apart == 1 and len(steps) < max(PAIRS * (len(film) - 1), 1):
            return None
    # One row for each step, weighed 1, and one for each exposure.
    rows = torch.zeros(len(steps), len(film), dtype=torch.float64)
    for row, (image, other) in zip(rows, steps, strict=True):
        row[image] = 1
        row[other] = -1
    weights = WEIGHT * torch.eye(len(film), dtype=torch.float64)
    seen = torch.stack(list(steps.values())).double()
    theta = torch.linalg.solve(rows.T @ rows + weights, rows.T @ seen)
    # Images in between have exposures in between.
    all_of_them = [np.interp(views.times, film.times, channel) for channel in theta.T.numpy()]
    found = torch.from_numpy(np.stack(all_of_them, axis=1)).float()
    return found - found.mean(dim=0)


def _small(views: Views) -> Views:
    """The images so small that flow just sees something in them; masks are not looked at."""
    factor = max(1.0, min(views.width, views.height) / LEAST_SIDE)
    width = round(views.width / factor)
    height = round(views.height / factor)
    pixels = [shrink_pixels(image.numpy(), width, height) for image in views.pixels.cpu()]
    return Views(
        torch.from_numpy(np.stack(pixels)), views.cameras, views.times, views.view, views.names
    )


def _step(film: Views, image: int, other: int, between: Estimator) -> Tensor | None:
    """(3,) the change of log(gain) from another image; None where flow follows too little."""
    vectors, valid = flow_between(film, image, other, between)
    if int(valid.sum()) < FOLLOWED * valid.numel():
        return None
    y, x = torch.meshgrid(torch.arange(film.height), torch.arange(film.width), indexing="ij")
    place = torch.stack([x, y], dim=-1) + 0.5 + vectors
    before = look_up_pixels(film.pixels[other].numpy(), place.numpy())
    now = film.pixels[image, ..., :3][valid].float()
    then = torch.from_numpy(before)[..., :3][valid].float()
    told = (torch.minimum(now, then) > DARKEST) & (torch.maximum(now, then) < BRIGHTEST)
    ratio = (now / then.clamp(min=1)).log()
    away = ratio - ratio.where(told, torch.nan).nanmedian(dim=0).values
    same = told & (away.abs() < SAME)  # false where there is no median
    if int(same.sum(dim=0).min()) < FOLLOWED * len(now):
        return None
    # Sums, since grey levels are whole numbers: the median of their ratios is often just 1.
    return ((now * same).sum(dim=0) / (then * same).sum(dim=0)).log()


def _halved(views: Views) -> Views:
    """Held-out views of which the left halves tell the gain, and the right ones are scored."""
    left = torch.zeros_like(views.pixels[..., 0], dtype=torch.bool)
    left[:, :, : views.width // 2] = True
    known = torch.ones_like(left) if views.valid_mask is None else views.valid_mask
    scored = known & ~left
    # What is only seen on the left is scored there.
    scored = torch.where(scored.any(dim=2).any(dim=1)[:, None, None], scored, known)
    return replace(views, valid_mask=scored, exposure_mask=known & left)
