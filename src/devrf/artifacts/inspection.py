"""What a scene holds, as data: found by looking at it, without learning anything."""

from __future__ import annotations

from dataclasses import dataclass

from devrf.artifacts.advice import Advice
from devrf.artifacts.camera_advice import box_middle, camera_advice, widest_gap
from devrf.artifacts.image_advice import MATTE, image_advice, mean_share
from devrf.geometry.clock import FrameClock
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Bounds, Scene, Views


@dataclass(frozen=True)
class ViewsFacts:
    """What is known of one set of images.

    Attributes:
        name: ``static train``, ``static test``, ``dynamic train`` or ``dynamic test``.
        images: how many there are.
        views: how many cameras took them.
        frames: at how many times.
        width: image width in pixels.
        height: image height in pixels.
        mattes: share of the pixels that mattes cover; None without an alpha channel.
        left_out: share of the pixels that do not count; None where all do.
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
    mattes: float | None
    left_out: float | None
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
        images: how many these are.
        valid: share of their pixels with valid flow.
        valid_on_matte: the same of the pixels on the matte; None without mattes.
        mean: mean length of valid flow in pixels; 0 without any.
        longest: the longest valid flow in pixels.
    """

    images: int
    valid: float
    valid_on_matte: float | None
    mean: float
    longest: float


@dataclass(frozen=True)
class Inspection:
    """What was found in a scene.

    Attributes:
        name: the scene's short name.
        kind: ``inward`` or ``forward``.
        background: what is behind the mattes.
        sets: the four sets of images; an empty one is left out.
        times: the times of the dynamic training views.
        bounds: box and motion box in the fields' space (world units, or NDC of a forward scene).
        gap: widest sector without a static view in degrees, seen from above; None of a
            forward-facing scene or where it cannot be said.
        flow: optical flow, or None where there is none.
        advice: what may be wrong.
    """

    name: str
    kind: str
    background: str
    sets: tuple[ViewsFacts, ...]
    times: TimesFacts
    bounds: Bounds
    gap: float | None
    flow: FlowFacts | None
    advice: tuple[Advice, ...]


def inspect_scene(scene: Scene) -> Inspection:
    """Look at a scene: counts, sizes, times, bounds, cameras, flow, and what may be wrong."""
    sets = [
        _views_facts(f"{capture} {part}", views, scene)
        for capture, of in (("static", scene.static), ("dynamic", scene.dynamic))
        for part, views in (("train", of.train), ("test", of.test))
        if len(views)
    ]
    inward = scene.kind == "inward"
    return Inspection(
        name=scene.name,
        kind=scene.kind,
        background=scene.background,
        sets=tuple(sets),
        times=_times_facts(scene.dynamic.train),
        bounds=scene.bounds,
        gap=widest_gap(scene.static.train.cameras, box_middle(scene)) if inward else None,
        flow=_flow_facts(scene.dynamic.train),
        advice=(*camera_advice(scene), *image_advice(scene)),
    )


def distinct_times(views: Views) -> tuple[float, ...]:
    """The times of N views, each once, ascending; equal up to rounding is equal."""
    kept: list[float] = []
    for time in sorted(views.times.tolist()):
        if not kept or time - kept[-1] > FrameClock.TOLERANCE:
            kept.append(time)
    return tuple(kept)


def _views_facts(name: str, views: Views, scene: Scene) -> ViewsFacts:
    cameras = views.cameras
    distance = (cameras.positions - box_middle(scene)).norm(dim=1)
    return ViewsFacts(
        name=name,
        images=len(views),
        views=len(set(views.view.tolist())),
        frames=len(distinct_times(views)),
        width=views.width,
        height=views.height,
        mattes=mean_share(k[..., 3] > MATTE for k in views.pixels) if views.has_alpha else None,
        left_out=None if views.valid_mask is None else mean_share(~k for k in views.valid_mask),
        focal=(float(cameras.focal.min()), float(cameras.focal.max())),
        distance=(float(distance.min()), float(distance.mean()), float(distance.max())),
    )


def _times_facts(views: Views) -> TimesFacts:
    times = distinct_times(views)
    steps = [b - a for a, b in zip(times, times[1:], strict=False)]
    mean = sum(steps) / len(steps) if steps else 0.0
    even = all(abs(step - mean) <= 0.01 * mean + FrameClock.TOLERANCE for step in steps)
    return TimesFacts(len(times), times[0], times[-1], even)


def _flow_facts(views: Views) -> FlowFacts | None:
    if views.flow is None:
        return None
    images = [image for image, _ in frame_pairs(views)]
    count, matte, on_matte, total, longest = 0, 0, 0, 0.0, 0.0
    for k in images:  # one by one: all of a large scene's flow at once would be copied
        valid = views.flow.valid[k]
        length = views.flow.vectors[k][valid].norm(dim=-1)
        count += len(length)
        total += float(length.sum())
        longest = max(longest, float(length.max())) if len(length) else longest
        if views.has_alpha:
            cut = views.pixels[k, ..., 3] > MATTE
            matte += int(cut.sum())
            on_matte += int((cut & valid).sum())
    area = len(images) * views.width * views.height
    return FlowFacts(
        images=len(images),
        valid=count / max(area, 1),
        valid_on_matte=on_matte / max(matte, 1) if views.has_alpha else None,
        mean=total / max(count, 1),
        longest=longest,
    )
