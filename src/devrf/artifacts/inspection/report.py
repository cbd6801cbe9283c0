"""What a scene holds, as data: found without training."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from devrf.artifacts.inspection.advice import Advice, image_sets
from devrf.artifacts.inspection.camera_advice import camera_advice
from devrf.artifacts.inspection.image_advice import OPAQUE, image_advice, mean_share
from devrf.artifacts.inspection.layout import box_middle, widest_gap
from devrf.geometry.clock import FrameClock
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Scene, Views


@dataclass(frozen=True)
class ViewsFacts:
    """Facts of one set of images.

    Attributes:
        name: as in :func:`devrf.artifacts.inspection.advice.image_sets`.
        images: number of images.
        views: number of cameras that took them.
        frames: number of distinct times.
        width: image width in pixels.
        height: image height in pixels.
        alpha_share: share of the pixels inside alpha masks; None without an alpha channel.
        masked_share: share of the pixels that masks leave out; None without masks.
        focal: least and largest focal length in pixels, both axes.
        distance: least, mean and largest distance of the cameras from the middle of the box,
            world units.
    """

    name: str
    images: int
    views: int
    frames: int
    width: int
    height: int
    alpha_share: float | None
    masked_share: float | None
    focal: tuple[float, float]
    distance: tuple[float, float, float]


@dataclass(frozen=True)
class TimesFacts:
    """The distinct times of the dynamic training views.

    Attributes:
        count: how many there are.
        first: the earliest.
        last: the latest.
        even: whether they are evenly spaced, to a hundredth of a step.
    """

    count: int
    first: float
    last: float
    even: bool


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
    """What was found in a scene.

    Attributes:
        scene: the scene.
        sets: facts of its four sets of images; an empty set is left out.
        times: the times of the dynamic training views.
        gap: widest sector without a static view in degrees, seen from above; None for a
            forward-facing scene or where it cannot be told.
        flow: optical flow, or None where there is none.
        advice: what may be wrong.
    """

    scene: Scene
    sets: tuple[ViewsFacts, ...]
    times: TimesFacts
    gap: float | None
    flow: FlowFacts | None
    advice: tuple[Advice, ...]


def inspect_scene(scene: Scene) -> Inspection:
    """Find counts, sizes, times, cameras and flow of a scene, and what may be wrong with it."""
    cameras, middle = scene.static.train.cameras, box_middle(scene)
    return Inspection(
        scene,
        sets=tuple(_views_facts(*named, middle) for named in image_sets(scene).items()),
        times=_times_facts(scene.dynamic.train),
        gap=widest_gap(cameras, middle) if scene.kind == "inward" else None,
        flow=_flow_facts(scene.dynamic.train),
        advice=(*camera_advice(scene), *image_advice(scene)),
    )


def _views_facts(name: str, views: Views, middle: Tensor) -> ViewsFacts:
    focal = views.cameras.focal
    distance = (views.cameras.positions - middle).norm(dim=1)
    alpha = (image[..., 3] > OPAQUE for image in views.pixels) if views.has_alpha else None
    masked = None if views.valid_mask is None else (~mask for mask in views.valid_mask)
    return ViewsFacts(
        name=name,
        images=len(views),
        views=len(set(views.view.tolist())),
        frames=len(_distinct_times(views)),
        width=views.width,
        height=views.height,
        alpha_share=None if alpha is None else mean_share(alpha),
        masked_share=None if masked is None else mean_share(masked),
        focal=(float(focal.min()), float(focal.max())),
        distance=(float(distance.min()), float(distance.mean()), float(distance.max())),
    )


def _distinct_times(views: Views) -> list[float]:
    """The times of the views, each once, ascending; equal up to rounding is equal."""
    kept: list[float] = []
    for time in sorted(views.times.tolist()):
        if not kept or time - kept[-1] > FrameClock.TOLERANCE:
            kept.append(time)
    return kept


def _times_facts(views: Views) -> TimesFacts:
    times = _distinct_times(views)
    steps = [b - a for a, b in zip(times, times[1:], strict=False)]
    mean = sum(steps) / max(len(steps), 1)
    even = all(abs(step - mean) <= 0.01 * mean + FrameClock.TOLERANCE for step in steps)
    return TimesFacts(len(times), times[0], times[-1], even)


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
