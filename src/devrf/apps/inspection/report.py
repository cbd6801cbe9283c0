"""Facts of a scene, found without training."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.apps.inspection.advice import Advice, image_sets
from devrf.apps.inspection.camera_advice import camera_advice
from devrf.apps.inspection.image_advice import OPAQUE, image_advice, mean_share
from devrf.apps.inspection.layout import box_middle, widest_gap
from devrf.data.color_change import color_change, color_drift
from devrf.geometry.clock import FrameClock
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Scene, Views


@dataclass(frozen=True)
class ViewsFacts:
    """Facts of one set of images.

    Attributes:
        name: as in :func:`devrf.apps.inspection.advice.image_sets`.
        views: the images.
        cameras: number of cameras that took them.
        frames: number of distinct times.
        alpha_share: share of the pixels inside alpha masks; None without an alpha channel.
        masked_share: share of the pixels that masks leave out; None without masks.
        focal: least and largest focal length in pixels, both axes.
        distance: least, mean and largest distance of the cameras from the middle of the box,
            world units.
    """

    name: str
    views: Views
    cameras: int
    frames: int
    alpha_share: float | None
    masked_share: float | None
    focal: tuple[float, float]
    distance: tuple[float, float, float]


@dataclass(frozen=True)
class FlowFacts:
    """Optical flow of the dynamic training views that have a frame before them.

    Attributes:
        images: number of these views.
        valid: share of their pixels with valid flow.
        valid_in_alpha: the same of the pixels inside alpha masks; None without these.
        mean: mean length of valid flow in pixels; 0 without any.
        longest: the longest valid flow in pixels.
    """

    images: int
    valid: float
    valid_in_alpha: float | None
    mean: float
    longest: float


@dataclass(frozen=True)
class Inspection:
    """Facts of a scene, and what may be wrong with it.

    Attributes:
        scene: the scene itself: name, kind, background, bounds.
        sets: one for each set that is not empty.
        times: the distinct times of the dynamic training views, ascending.
        even: whether these are evenly spaced, to a hundredth of a step.
        gap: the widest sector, in degrees from above, without a static training view; None in
            a forward-facing scene or where it cannot be told.
        flow: optical flow, or None where there is none.
        color_change: see :func:`devrf.data.color_change.color_change`.
        color_drift: see :func:`devrf.data.color_change.color_drift`.
        advice: what may be wrong.
    """

    scene: Scene
    sets: tuple[ViewsFacts, ...]
    times: tuple[float, ...]
    even: bool
    gap: float | None
    flow: FlowFacts | None
    color_change: float | None
    color_drift: float | None
    advice: tuple[Advice, ...]


def inspect_scene(scene: Scene) -> Inspection:
    """Find counts, sizes, times, cameras and flow of a scene, and what may be wrong with it."""
    cameras, middle = scene.static.train.cameras, box_middle(scene)
    times = _distinct_times(scene.dynamic.train)
    steps = times.diff()
    return Inspection(
        scene,
        sets=tuple(_views_facts(*named, middle) for named in image_sets(scene).items()),
        times=tuple(times.tolist()),
        even=torch.allclose(steps, steps.mean(), rtol=0.01, atol=FrameClock.TOLERANCE),
        gap=widest_gap(cameras, middle) if scene.kind == "inward" else None,
        flow=_flow_facts(scene.dynamic.train),
        color_change=color_change(scene.dynamic.train),
        color_drift=color_drift(scene.dynamic.train),
        advice=(*camera_advice(scene), *image_advice(scene)),
    )


def _views_facts(name: str, views: Views, middle: Tensor) -> ViewsFacts:
    distance = (views.cameras.positions - middle).norm(dim=1)
    nearest, furthest = distance.aminmax()
    least, most = views.cameras.focal.aminmax()
    alpha = (image[..., 3] > OPAQUE for image in views.pixels) if views.has_alpha else None
    masked = None if views.valid_mask is None else (~mask for mask in views.valid_mask)
    return ViewsFacts(
        name,
        views,
        cameras=len(set(views.view.tolist())),
        frames=len(_distinct_times(views)),
        alpha_share=None if alpha is None else mean_share(alpha),
        masked_share=None if masked is None else mean_share(masked),
        focal=(float(least), float(most)),
        distance=(float(nearest), float(distance.mean()), float(furthest)),
    )


def _distinct_times(views: Views) -> Tensor:
    """The times of the views, each once, ascending; equal up to rounding is equal."""
    times = views.times.sort().values
    return times[times.diff(prepend=times.new_tensor([-1.0])) > FrameClock.TOLERANCE]


def _flow_facts(views: Views) -> FlowFacts | None:
    if views.flow is None:
        return None
    images = [image for image, _ in frame_pairs(views)]
    count, inside, covered, total, longest = 0, 0, 0, 0.0, 0.0
    for k in images:  # one by one: all of a large scene's flow at once would be copied
        valid = views.flow.valid[k]
        length = views.flow.vectors[k][valid].norm(dim=-1)
        count += len(length)
        total += float(length.sum())
        longest = max(longest, float(length.max())) if len(length) else longest
        if views.has_alpha:
            alpha = views.pixels[k, ..., 3] > OPAQUE
            inside += int(alpha.sum())
            covered += int((alpha & valid).sum())
    return FlowFacts(
        images=len(images),
        valid=count / max(len(images) * views.width * views.height, 1),
        valid_in_alpha=covered / max(inside, 1) if views.has_alpha else None,
        mean=total / max(count, 1),
        longest=longest,
    )
