"""Facts of a scene, found without training, and how they read."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from torch import Tensor

from devrf.apps.inspection.advice import (
    OPAQUE,
    Advice,
    camera_advice,
    image_advice,
    image_sets,
    mean_share,
)
from devrf.apps.inspection.layout import box_middle, widest_gap
from devrf.data.color_change import CHANGING, color_change, color_drift
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


HEADING = "set,images,views x times,size,alpha masks,masks,focal length,distance".split(",")


def inspection_text(found: Inspection, requirements: Sequence[Sequence[str]]) -> RenderableType:
    """The report for a terminal; ``requirements`` of a run are rows of a name and an amount."""
    count = len(found.advice)
    verdict = f"problems found: {count}" if count else "no problems found"
    return Group(
        _titled_table("what was found", _facts(found)),
        _titled_table("images", [_images(facts) for facts in found.sets], HEADING),
        _titled_table("what a run will need, estimated", requirements),
        Text(verdict, style="bold yellow" if count else "bold green"),
        *(
            Text.assemble((f"  {a.where}", "yellow"), f": {a.what}; ", (a.remedy, "italic"))
            for a in found.advice
        ),
    )


def as_text(shown: RenderableType) -> str:
    """The report for a log: without colours and trailing spaces, no line wrapped."""
    console = Console(file=io.StringIO(), width=10_000, record=True)
    console.print(shown)
    return "\n".join(map(str.rstrip, console.export_text().splitlines()))


def _titled_table(
    title: str, rows: Sequence[Sequence[str]], heading: Sequence[str] | None = None
) -> RenderableType:
    """An indented table of text with a title above and an empty line below."""
    table = Table(box=None, show_header=heading is not None, padding=(0, 2, 0, 0))
    for k, name in enumerate(heading or [""] * len(rows[0])):
        table.add_column(name, style="" if k else "cyan")
    for row in rows:
        table.add_row(*map(Text, row))  # Text: a name may hold [brackets]
    return Group(Text(title, style="bold"), Padding(table, (0, 0, 1, 2)))


def _facts(found: Inspection) -> list[tuple[str, str]]:
    scene, bounds, times = found.scene, found.scene.bounds, found.times
    spacing = "evenly spaced" if found.even else "unevenly spaced"
    span = f"{len(times)} from {times[0]:g} to {times[-1]:g}, {spacing}"
    unit = "NDC" if scene.kind == "forward" else "world units"
    motion = "" if bounds.motion is None else f"{bounds.motion}, "
    rows = [
        ("scene", f"{scene.name}, {scene.kind}-facing, {scene.background} background"),
        ("times", span if scene.moves else "one moment: the scene is at rest"),
        ("space", _space(scene)),
        ("near, far", f"{bounds.near:.4g}, {bounds.far:.4g} ({unit})"),
        ("box", f"{scene.space.inner(bounds.box)}{_why(bounds.box_source)}"),
        ("room for motion", f"{motion}{bounds.source}"),
        ("optical flow", _flow(found.flow)),
    ]
    if found.color_change is not None:
        rows.append(("colours along the flow", _colors(found.color_change, found.color_drift)))
    if found.gap is not None:
        rows.insert(2, ("static views", f"widest sector without one: {found.gap:.0f} degrees"))
    return rows


def _colors(change: float, drift: float | None) -> str:
    """How much colours change, and whether that is worth learning."""
    said = f"differ by {100 * change:.1f} % over a few frames"
    if drift is None:
        return said
    said += f", drift by {100 * drift:.1f} % over all"
    return f"{said}: try schedule.appearance.learn=always" if drift >= CHANGING else said


def _space(scene: Scene) -> str:
    """The space that fields live in, and why."""
    name = "normalised device coordinates" if scene.kind == "forward" else "the world"
    if not scene.space.is_linear:
        name = "contracted: beyond the box everything to infinity is squeezed into a shell"
    return name + _why(scene.bounds.reason)


def _why(reason: str) -> str:
    return f" ({reason})" if reason else ""


def _flow(flow: FlowFacts | None) -> str:
    if flow is None:
        return "none"
    inside = flow.valid_in_alpha
    in_alpha = "" if inside is None else f" ({_percent(inside)} of the alpha masks)"
    return (
        f"{flow.images} images, valid on {_percent(flow.valid)} of the pixels{in_alpha}, "
        f"mean {flow.mean:.1f} px, longest {flow.longest:.1f} px"
    )


def _images(facts: ViewsFacts) -> tuple[str, ...]:
    least, most = facts.focal
    near, mean, far = facts.distance
    alpha, masked, views = facts.alpha_share, facts.masked_share, facts.views
    return (
        facts.name,
        str(len(views)),
        f"{facts.cameras} x {facts.frames}",
        f"{views.width} x {views.height}",
        "no" if alpha is None else f"cover {_percent(alpha)}",
        "no" if masked is None else f"leave out {_percent(masked)}",
        f"{least:.0f} px" if most - least < 0.5 else f"{least:.0f} to {most:.0f} px",
        f"{mean:.3g}" if far - near < 0.01 * mean else f"{near:.3g} to {far:.3g}",
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
