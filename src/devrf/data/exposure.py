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
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from devrf.scenes.optical_flow import LEAST_SIDE, Estimator, consistent, estimator
from devrf.scenes.reader import Exposure
from devrf.scenes.resampling import look_up_pixels, shrink_pixels
from devrf.scenes.scene import Scene, Views

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
# Gains nearer to 1 change nothing that was too bright.
TRIFLE = 0.01
# The second eigenvalue of the comparisons is below this where some images are compared with none
# of the others.
CONNECTED = 1e-6
# The share of followed pixels that have to agree: of noise a sixth does.
AGREE = 0.25
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
    possible = scene.is_film and scene.moves and not train.cut_out
    theta = exposures(train) if possible and choice != "none" else None
    if theta is None:
        if choice == "equal":
            why = "no film by one camera, or too little to follow in it"
            log.info("%s: data.exposure=equal: %s; images stay as they are", scene.name, why)
        return scene
    drift = float((theta.amax(dim=0) - theta.amin(dim=0)).max())
    if choice == "auto" and drift < DRIFT:
        return scene
    log.info(
        "%s: exposure changes by %.0f %% and is made equal; held-out images are scored on their "
        "right halves, with gains that their left ones tell (data.exposure=none: as they are)",
        scene.name,
        100 * math.expm1(drift),
    )
    moving = replace(scene.dynamic.mapped(_halved), train=_equal(train, theta))
    if scene.static.train is train:
        return replace(scene, static=replace(moving, validation=None), dynamic=moving)
    known = dict(zip(train.names, theta, strict=True))
    names = scene.static.train.names
    places = torch.tensor([k for k, name in enumerate(names) if name in known])
    found = torch.stack([known[names[k]] for k in places.tolist()])
    rest = scene.static.mapped(_halved)
    rest = replace(rest, train=_equal(scene.static.train, _between(places, found, len(names))))
    return replace(scene, static=rest, dynamic=moving)


def _equal(views: Views, theta: Tensor) -> Views:
    """The views without their exposures ``theta`` (N, 3).

    What was too bright to be told, or would be now, is not valid.
    """
    gain = (-theta).exp()[:, None, None]
    colors = views.pixels[..., :3]
    bright = (colors > BRIGHTEST) & (gain < 1 - TRIFLE)
    equal = (colors * gain).round()
    told = ~(bright | (equal > 255 * (1 + TRIFLE))).any(dim=-1)
    pixels = torch.cat([equal.clamp(max=255).to(torch.uint8), views.pixels[..., 3:]], dim=-1)
    valid = told if views.valid_mask is None else views.valid_mask & told
    return replace(views, pixels=pixels, valid_mask=valid)


def _between(places: Tensor, values: Tensor, count: int) -> Tensor:
    """(``count``, 3) values at all places, from those (M, 3) at some of them, in between evenly."""
    there = np.arange(count)
    channels = [np.interp(there, places.numpy(), channel.numpy()) for channel in values.T]
    return torch.from_numpy(np.stack(channels, axis=1)).float()


def exposures(views: Views) -> Tensor | None:
    """(N, 3) log(gain) of each image's red, green and blue, of mean 0, in the order of the views.

    None where flow follows too little: a camera that leaps, or too few pixels in common.

    Args:
        views: N images that one moving camera took one after another.
    """
    order = views.times.argsort(stable=True)
    spread = torch.arange(0, len(views), math.ceil(len(views) / MOST))
    film = _small(views[order[spread]])
    between = estimator("dis")
    steps: dict[tuple[int, int], Tensor] = {}
    for apart in APART:
        for k in range(apart, len(film)):
            if (step := _step(film, k, k - apart, between)) is not None:
                steps[k, k - apart] = step
        if apart == 1 and len(steps) < max(PAIRS * (len(film) - 1), 1):
            return None
    # One row for each step.
    rows = torch.zeros(len(steps), len(film), dtype=torch.float64)
    for row, (image, other) in zip(rows, steps, strict=True):
        row[image] = 1
        row[other] = -1
    known = rows.any(dim=0).nonzero()[:, 0]
    rows = rows[:, known]
    squares = rows.T @ rows
    if float(torch.linalg.eigvalsh(squares)[1]) < CONNECTED:
        return None
    seen = torch.stack(list(steps.values())).double()
    weights = WEIGHT * torch.eye(len(known), dtype=torch.float64)
    theta = torch.linalg.solve(squares + weights, rows.T @ seen)
    # Images that were not compared, or not followed, have exposures in between.
    found = _between(spread[known], theta, len(views))
    return (found - found.mean(dim=0))[order.argsort()]


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
    there = between(film.pixels[image, ..., :3], film.pixels[other, ..., :3])
    back = between(film.pixels[other, ..., :3], film.pixels[image, ..., :3])
    forth = _ratio(film, image, other, there, consistent(there, back))
    again = _ratio(film, other, image, back, consistent(back, there))
    # What one image is blurred by, looked up in between its pixels, cancels out.
    return None if forth is None or again is None else (forth - again) / 2


def _ratio(film: Views, image: int, other: int, flow: Tensor, valid: Tensor) -> Tensor | None:
    """(3,) log(Σ C / Σ C') of an image and another where ``flow`` (H, W, 2) is ``valid`` (H, W)."""
    if int(valid.sum()) < FOLLOWED * valid.numel():
        return None
    y, x = torch.meshgrid(torch.arange(film.height), torch.arange(film.width), indexing="ij")
    place = torch.stack([x, y], dim=-1) + 0.5 + flow
    before = look_up_pixels(film.pixels[other, ..., :3].numpy(), place.numpy())
    now = film.pixels[image, ..., :3][valid].float()
    then = torch.from_numpy(before)[valid].float()
    told = (torch.minimum(now, then) > DARKEST) & (torch.maximum(now, then) < BRIGHTEST)
    ratio = (now / then.clamp(min=1)).log()
    away = ratio - ratio.where(told, torch.nan).nanmedian(dim=0).values
    same = told & (away.abs() < SAME)  # false where there is no median
    if int(same.sum(dim=0).min()) < AGREE * len(now):
        return None
    # Sums, since grey levels are whole numbers: the median of their ratios is often just 1.
    return ((now * same).sum(dim=0) / (then * same).sum(dim=0)).log()


def _halved(views: Views) -> Views:
    """Held-out views of which the left halves tell the gain, and the right ones are scored."""
    middle = views.cameras.extents[:, :1, None] // 2
    left = (torch.arange(views.width) < middle).expand(views.pixels.shape[:3])
    known = torch.ones_like(left) if views.valid_mask is None else views.valid_mask
    scored = known & ~left
    # What is only seen on the left is scored there.
    scored = torch.where(scored.any(dim=2).any(dim=1)[:, None, None], scored, known)
    return replace(views, valid_mask=scored, exposure_mask=known & left)
