"""Scores of motion: masks of what moves in held-out images, points that are followed, flicker."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from devrf.data.flow import previous_images
from devrf.evaluation.held_out import HeldOutView
from devrf.evaluation.predictions import pictures_in
from devrf.geometry.motion import MOVED, radius
from devrf.rendering.renderer import Renderer
from devrf.rendering.tracks import shown_points, track
from devrf.scenes.masks import HALF, WHITE, white_in
from devrf.scenes.optical_flow import ALPHA_THRESHOLD, estimator
from devrf.scenes.scene import Background, Capture, Views, background_value, on_background
from devrf.system.progress import followed

# An image is compared with so many of its camera's, evenly spread over time.
REFERENCES = 8
# Pixels of the shorter side of images between which optical flow is found, at least; larger images
# have less than twice as many.
SIDE = 256
# A pixel moves if in most of these pairs flow leads it farther than SHIFTED times the radius of
# what the image shows (ways look shorter than they are), and a channel changes by more than
# CHANGED at most a pixel away (flow reaches beyond the edges of what moves), and more than NOISE
# times the median change: that is the cameras' noise, of which one of 27 values is four deviations.
SHIFTED = MOVED / 2
CHANGED = 0.05
NOISE = 6.0
# A point is followed rightly if it comes within this share of the image's larger side (DyCheck).
NEAR = 0.05
# The rest pose says something of the motion where it scores so many dB less than the scene at rest.
TELLING = 6.0


def with_motion_masks(
    views: Views, background: Background, given: str | Path | None
) -> tuple[Views, str | None]:
    """Held-out views with masks of what moves, and the rule by which these were made.

    The same masks serve every method (docs/stages.md#moving): the ``given`` ones, else the exact
    ones that the views have, else those of :func:`shifted` pixels. None: no rule gives any.

    Raises:
        DevrfError: a mask is missing in the folder ``given``, of another size than its image, or
            one of labels other than 0 and 1.
    """
    if given is not None:
        mask = torch.zeros_like(views.pixels[..., 0], dtype=torch.bool)
        picture = pictures_in(Path(given), views)
        masks = [picture(image)[..., 0].copy() for image in range(len(views))]
        labels = white_in(masks, given) < WHITE
        for image, grey in enumerate(masks):
            height, width = grey.shape
            mask[image, :height, :width] = torch.from_numpy(grey) > (0 if labels else HALF)
        return replace(views, motion_mask=mask), f"given: {Path(given).resolve()}"
    if views.motion_mask is not None:
        return views, "exact"
    mask = shifted(views, background)
    rule = f"optical flow (DIS) longer than {SHIFTED:g} radii"
    return (replace(views, motion_mask=mask), rule) if bool(mask.any()) else (views, None)


def shifted(views: Views, background: Background) -> Tensor:
    """Mask (N, H, W) of pixels that optical flow between images of their fixed camera moves."""
    mask = torch.zeros_like(views.pixels[..., 0], dtype=torch.bool)
    opaque = views.pixels[..., 3] > ALPHA_THRESHOLD if views.has_alpha else ~mask
    between = estimator("dis", least_side=SIDE)
    for camera in {*views.view.tolist()}:
        own = (views.view == camera).nonzero()[:, 0]
        own = own[views.times[own].argsort()]
        if len(own) < 2:
            continue
        images = [_reduced(pixels, background) for pixels in views.pixels[own]]
        height, width = images[0].shape[:2]
        scale = views.height / height
        evenly = torch.linspace(0, len(own) - 1, min(REFERENCES, len(own))).round().long().tolist()
        # Of these alone: a pixel's place takes 32 bytes, of hundreds of images 13 GB.
        limit = SHIFTED * radius(opaque[own[evenly]].nonzero()[:, 1:].float()) / scale
        for k, image in followed(enumerate(images), len(images), "motion masks"):
            others = [images[reference] for reference in evenly if reference != k]
            votes = torch.zeros(height, width)
            for other in others:
                change = (image.float() - other.float()).abs() / 255
                least = max(CHANGED, NOISE * float(change.median()))
                near = max_pool2d(change.amax(dim=-1)[None], 3, 1, 1)[0] > least
                votes += near & (between(image, other).norm(dim=-1) > limit)
            moves = (votes > len(others) / 2).float()[None, None]
            whole = interpolate(moves, (views.height, views.width))[0, 0] > 0
            mask[own[k]] = whole & opaque[own[k]]
    return mask


def _reduced(pixels: Tensor, background: Background) -> Tensor:
    """An image (H, W, 3 or 4) as RGB (H', W', 3) uint8 of the size at which flow is found."""
    color = on_background(pixels, background_value(background)).permute(2, 0, 1)[None]
    height, width = color.shape[2:]
    factor = max(min(height, width) // SIDE, 1)
    small = interpolate(color, (height // factor, width // factor), mode="area")[0]
    return (small.permute(1, 2, 0) * 255).round().to(torch.uint8)


def flicker(views: Views, scored: Sequence[HeldOutView]) -> list[float | None]:
    """Mean |e_t − e_{t−1}| of each image of a fixed camera and the one before it, in [0, 1].

    e is the signed error of a channel, the prediction less the truth; only pixels that are valid in
    both images count. None for a camera's first image, for cameras that move, and where the image
    before has another size.
    """
    values: list[float | None] = []
    for image, earlier in enumerate(previous_images(views).tolist()):
        same_raster = scored[image].truth.shape == scored[earlier].truth.shape
        if earlier == image or views.by_moving_camera or not same_raster:
            values.append(None)
            continue
        errors = [scored[k].compared - scored[k].truth for k in (image, earlier)]
        change = (errors[0] - errors[1]).abs().mean(dim=-1)
        valid = torch.ones_like(change, dtype=torch.bool)
        for mask in map(views.valid_mask_of, (image, earlier)):
            valid = valid if mask is None else valid & mask
        values.append(float(change[valid].mean()) if bool(valid.any()) else None)
    return values


def with_flicker(views: Views, scored: Sequence[HeldOutView]) -> list[HeldOutView]:
    """The scored ``views``, each with its :func:`flicker`."""
    return [
        replace(view, further={**view.further, "flicker": value})
        for view, value in zip(scored, flicker(views, scored), strict=True)
    ]


@torch.no_grad()
def pck_t(renderer: Renderer, capture: Capture) -> float | None:
    """The share of key points that the model's field carries rightly to images at other times.

    DyCheck's PCK-T (docs/stages.md#pck): the point at the mean depth of the ray through a key point
    of a training image is followed to the time of another, and projected into it. None without key
    points, or if the method does not follow points.
    """
    views, keypoints = capture.train, capture.keypoints
    if keypoints is None:
        return None
    sides = views.cameras.extents[:, None].float()
    places, shown = keypoints[..., :2] * sides, keypoints[..., 2] > 0
    annotated = shown.any(dim=1).nonzero()[:, 0].tolist()
    times = sorted({*views.times[annotated].tolist()})
    right, total = 0, 0
    for image in annotated:
        time = float(views.times[image])
        points, _ = shown_points(renderer, views.cameras.single(image), places[image], time)
        tracks = track(renderer.model, points, time, times)
        if tracks is None:
            return None
        for other in annotated:
            both = shown[image] & shown[other]
            if views.times[other] == time or not bool(both.any()):
                continue
            place = tracks[times.index(float(views.times[other]))].cpu()
            pixels, ahead = views.cameras.project_into(other, place)
            away = (pixels - places[other]).norm(dim=1)
            near = (away <= NEAR * sides[other].max()) & (ahead > 0)
            right += int((near & both).sum())
            total += int(both.sum())
    return round(right / total, 5) if total else None


def mostly_lost(sections: Mapping[str, Mapping[str, Any]]) -> str | None:
    """A line where the scene in motion scores nearer to the rest pose than to the scene at rest.

    None: it does not, or the figures are not known, or do not tell since hardly anything moves.
    """
    at_rest = sections.get("static", {}).get("psnr")
    dynamic = sections.get("dynamic", {})
    motion, pose = dynamic.get("psnr"), dynamic.get("rest_pose_psnr")
    if at_rest is None or motion is None or pose is None or at_rest - pose < TELLING:
        return None
    if motion >= (at_rest + pose) / 2:
        return None
    return (
        f"much of the motion was not found: {motion:.1f} dB, the rest pose {pose:.1f}, "
        f"the scene at rest {at_rest:.1f}"
    )
