"""The exposure of each image of a video: estimated along the motion, and made equal.

A phone's gain and white balance follow its picture. Optical flow leads from image k of a video to
the same points in image j, 1, 4 or 16 places before. Over the pixels that it leads right,
s(k, j) = log(Σ C(k) / Σ C(j)) is, for each channel, the step of the exposure θ = log(gain). All θ
together solve

    min Σ_{k,j} |θ(k) − θ(j) − s(k, j)|² + 10⁻⁴ Σ_k |θ(k)|²

and training images are divided by their gains. This is done before anything is learned: all methods
learn from the same images, and no checkpoint holds a gain.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from devrf.scenes.optical_flow import LEAST_SIDE, Estimator, consistent, estimator
from devrf.scenes.reader import Exposure
from devrf.scenes.resampling import interpolate_pixels, shrink_pixels
from devrf.scenes.scene import Scene, Views

log = logging.getLogger(__name__)

# Exposures that differ by less than this, as log(gain), are left alone: content changes as much.
DRIFT = 0.15
# At most so many images are compared.
MOST = 100
# Weight of the pull of all exposures to their mean.
WEIGHT = 1e-4
# Grey levels at which a channel still tells a ratio.
DARKEST, BRIGHTEST = 12, 248
# Pixels whose log ratio is farther than this from the median show something else.
SAME = 0.15
# Images so many places apart are compared: sums of many small steps are not exact.
APART = (1, 4, 16)
# Gains nearer to 1 do not reveal that a pixel was too bright.
TRIFLE = 0.01
# The second eigenvalue of the comparisons is below this if some images are compared with none of
# the others.
CONNECTED = 1e-6
# The share of followed pixels that have to agree: a sixth of noise does.
AGREE = 0.25
# Flow has to follow this share of the pixels, in this share of the pairs of images.
FOLLOWED = 0.15
PAIRS = 0.9


def with_equal_exposure(scene: Scene, choice: Exposure) -> Scene:
    """The scene with training images of one exposure, where one camera filmed it.

    Held-out images are scored on their right halves, with gains estimated on their left halves.

    Args:
        scene: as its reader gave it.
        choice: ``auto`` makes exposures equal that differ by more than a seventh, ``equal`` makes
            all equal, ``none`` changes nothing.
    """
    train = scene.dynamic.train
    possible = scene.is_monocular and scene.moves and not train.cut_out
    theta = exposures(train) if possible and choice != "none" else None
    if theta is None:
        if choice == "equal":
            why = "no video by one camera, or too little in it that flow can follow"
            log.info("%s: data.exposure=equal: %s; images stay as they are", scene.name, why)
        return scene
    drift = float((theta.amax(dim=0) - theta.amin(dim=0)).max())
    if choice == "auto" and drift < DRIFT:
        return scene
    log.info(
        "%s: exposure changes by %.0f %% and is made equal; held-out images are scored on their "
        "right halves, with gains from their left halves (data.exposure=none: as they are)",
        scene.name,
        100 * math.expm1(drift),
    )
    moving = replace(scene.dynamic.mapped(_halved), train=_equal(train, theta))
    if scene.static.train is train:
        return replace(scene, static=replace(moving, validation=None), dynamic=moving)
    theta_of = dict(zip(train.names, theta, strict=True))
    names = scene.static.train.names
    shared = torch.tensor([k for k, name in enumerate(names) if name in theta_of])
    shared_theta = torch.stack([theta_of[names[k]] for k in shared.tolist()])
    static_theta = _between(shared, shared_theta, len(names))
    static = scene.static.mapped(_halved)
    static = replace(static, train=_equal(scene.static.train, static_theta))
    return replace(scene, static=static, dynamic=moving)


def _equal(views: Views, theta: Tensor) -> Views:
    """The views without their exposures ``theta`` (N, 3).

    Pixels that were overexposed, or would be now, are not valid.
    """
    gain = (-theta).exp()[:, None, None]
    colors = views.pixels[..., :3]
    bright = (colors > BRIGHTEST) & (gain < 1 - TRIFLE)
    equal = (colors * gain).round()
    measured = ~(bright | (equal > 255 * (1 + TRIFLE))).any(dim=-1)
    pixels = torch.cat([equal.clamp(max=255).to(torch.uint8), views.pixels[..., 3:]], dim=-1)
    valid = measured if views.valid_mask is None else views.valid_mask & measured
    return replace(views, pixels=pixels, valid_mask=valid)


def _between(rows: Tensor, values: Tensor, count: int) -> Tensor:
    """(``count``, 3) values of all rows, linear between those (M, 3) of some ``rows`` (M,)."""
    everything = np.arange(count)
    channels = [np.interp(everything, rows.numpy(), channel.numpy()) for channel in values.T]
    return torch.from_numpy(np.stack(channels, axis=1)).float()


def exposures(views: Views) -> Tensor | None:
    """(N, 3) log(gain) of each image's red, green and blue, of mean 0, in the order of the views.

    None where flow follows too little: the camera leaps, or images share too few pixels.

    Args:
        views: N images that one moving camera took one after another.
    """
    order = views.times.argsort(stable=True)
    spread = torch.arange(0, len(views), math.ceil(len(views) / MOST))
    video = _small(views[order[spread]])
    between = estimator("dis")
    steps: dict[tuple[int, int], Tensor] = {}
    for apart in APART:
        for k in range(apart, len(video)):
            if (step := _step(video, k, k - apart, between)) is not None:
                steps[k, k - apart] = step
        if apart == 1 and len(steps) < max(PAIRS * (len(video) - 1), 1):
            return None
    # One row for each step.
    rows = torch.zeros(len(steps), len(video), dtype=torch.float64)
    for row, (image, other) in zip(rows, steps, strict=True):
        row[image] = 1
        row[other] = -1
    compared = rows.any(dim=0).nonzero()[:, 0]
    rows = rows[:, compared]
    squares = rows.T @ rows
    if float(torch.linalg.eigvalsh(squares)[1]) < CONNECTED:
        return None
    measured = torch.stack(list(steps.values())).double()
    weights = WEIGHT * torch.eye(len(compared), dtype=torch.float64)
    theta = torch.linalg.solve(squares + weights, rows.T @ measured)
    # Images that were not compared, or not followed, have exposures in between.
    all_theta = _between(spread[compared], theta, len(views))
    return (all_theta - all_theta.mean(dim=0))[order.argsort()]


def _small(views: Views) -> Views:
    """The images at the smallest size that flow can follow, without masks."""
    factor = max(1.0, min(views.width, views.height) / LEAST_SIDE)
    width = round(views.width / factor)
    height = round(views.height / factor)
    pixels = [shrink_pixels(image.numpy(), width, height) for image in views.pixels.cpu()]
    return Views(
        torch.from_numpy(np.stack(pixels)), views.cameras, views.times, views.view, views.names
    )


def _step(video: Views, image: int, other: int, between: Estimator) -> Tensor | None:
    """(3,) the change of log(gain) from another image; None where flow follows too little."""
    there = between(video.pixels[image, ..., :3], video.pixels[other, ..., :3])
    back = between(video.pixels[other, ..., :3], video.pixels[image, ..., :3])
    forth = _ratio(video, image, other, there, consistent(there, back))
    again = _ratio(video, other, image, back, consistent(back, there))
    # The blur by interpolation between the pixels of one image cancels out.
    return None if forth is None or again is None else (forth - again) / 2


def _ratio(video: Views, image: int, other: int, flow: Tensor, valid: Tensor) -> Tensor | None:
    """(3,) log(Σ C / Σ C') of an image and another where ``flow`` (H, W, 2) is ``valid`` (H, W)."""
    if int(valid.sum()) < FOLLOWED * valid.numel():
        return None
    y, x = torch.meshgrid(torch.arange(video.height), torch.arange(video.width), indexing="ij")
    source = torch.stack([x, y], dim=-1) + 0.5 + flow
    before = interpolate_pixels(video.pixels[other, ..., :3].numpy(), source.numpy())
    now = video.pixels[image, ..., :3][valid].float()
    then = torch.from_numpy(before)[valid].float()
    usable = (torch.minimum(now, then) > DARKEST) & (torch.maximum(now, then) < BRIGHTEST)
    ratio = (now / then.clamp(min=1)).log()
    away = ratio - ratio.where(usable, torch.nan).nanmedian(dim=0).values
    same = usable & (away.abs() < SAME)  # false where there is no median
    if int(same.sum(dim=0).min()) < AGREE * len(now):
        return None
    # Sums, since grey levels are whole numbers: the median of their ratios is often just 1.
    return ((now * same).sum(dim=0) / (then * same).sum(dim=0)).log()


def _halved(views: Views) -> Views:
    """Held-out views with the gain estimated on their left halves, scored on their right ones."""
    middle = views.cameras.extents[:, :1, None] // 2
    left = (torch.arange(views.width) < middle).expand(views.pixels.shape[:3])
    valid = torch.ones_like(left) if views.valid_mask is None else views.valid_mask
    scored = valid & ~left
    # Images without valid pixels on the right are scored on the left.
    scored = torch.where(scored.any(dim=2).any(dim=1)[:, None, None], scored, valid)
    return replace(views, valid_mask=scored, exposure_mask=valid & left)
