"""Facts of a scene, found without training, as tables of text; and a line for each advice."""

from __future__ import annotations

import io
import logging
from collections.abc import Sequence

import torch
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from torch import Tensor

from devrf.apps.inspection.advice import (
    OPAQUE,
    Advice,
    advice_on,
    image_sets,
    listed,
    masked_share,
    mean_share,
)
from devrf.apps.inspection.layout import box_middle, widest_gap
from devrf.data.color_change import CHANGING, color_change, color_drift
from devrf.geometry.clock import FrameClock
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Scene, Views
from devrf.scenes.splits import distinct_times

log = logging.getLogger(__name__)

HEADING = "set,images,views x times,size,alpha masks,masks,focal length,distance".split(",")
Row = tuple[str, ...]


def inspection_text(
    scene: Scene, requirements: Sequence[Sequence[str]], shortage: Advice | None = None
) -> RenderableType:
    """The report for a terminal; ``requirements`` of a run are rows of a name and an amount.

    ``shortage`` names a resource of which this machine has too little for the run.
    """
    advice = [*advice_on(scene), *([] if shortage is None else [shortage])]
    verdict = f"problems found: {len(advice)}" if advice else "no problems found"
    return Group(
        titled_table("what was found", scene_facts(scene)),
        titled_table("images", image_facts(scene), HEADING),
        titled_table("what a run will need, estimated", requirements),
        Text(verdict, style="bold yellow" if advice else "bold green"),
        *(
            Text.assemble((f"  {where}", "yellow"), f": {problem}; ", (remedy, "italic"))
            for where, problem, remedy in advice
        ),
    )


def show(report: RenderableType) -> None:
    """Print a report on a terminal, else log it."""
    console = Console()
    if console.is_terminal:
        console.print(report)
    else:
        log.info("%s", as_text(report))


def as_text(content: RenderableType) -> str:
    """The report for a log: without colours and trailing spaces, no line wrapped."""
    console = Console(file=io.StringIO(), width=10_000, record=True)
    console.print(content)
    return "\n".join(map(str.rstrip, console.export_text().splitlines()))


def titled_table(
    title: str, rows: Sequence[Sequence[str]], heading: Sequence[str] | None = None
) -> RenderableType:
    """An indented table of text with a title above and an empty line below."""
    table = Table(box=None, show_header=heading is not None, padding=(0, 2, 0, 0))
    for k, name in enumerate(heading or [""] * len(rows[0])):
        table.add_column(name, style="" if k else "cyan")
    for row in rows:
        table.add_row(*map(Text, row))  # Text: a name may hold [brackets]
    return Group(Text(title, style="bold"), Padding(table, (0, 0, 1, 2)))


def scene_facts(scene: Scene) -> list[Row]:
    """Facts of a scene: space, bounds, times, motion and colours, as rows of a name and text."""
    bounds = scene.bounds
    views = scene.dynamic.train
    unit = "NDC" if scene.kind == "forward" else "world units"
    space = "normalised device coordinates" if scene.kind == "forward" else "the world"
    if not scene.space.is_linear:
        space = "contracted: beyond the box everything to infinity is squeezed into a shell"
    motion = "" if bounds.motion is None else f"{bounds.motion}, "
    rows: list[Row] = [
        ("scene", f"{scene.name}, {scene.kind}-facing, {scene.background} background"),
        ("times", _times(views) if scene.moves else "one moment: the scene is at rest"),
        ("space", f"{space}{_why(bounds.reason)}"),
        ("near, far", f"{bounds.near:.4g}, {bounds.far:.4g} ({unit})"),
        ("box", f"{scene.space.inner(bounds.box)}{_why(bounds.box_source)}"),
        ("room for motion", f"{motion}{bounds.source}"),
        ("optical flow", flow_facts(views)),
    ]
    change = color_change(views)
    drift = color_drift(views)
    if change is not None:
        text = f"differ by {100 * change:.1f} % over a few frames"
        if drift is not None:
            text += f", drift by {100 * drift:.1f} % over all"
            text += ": try schedule.extensions.color_residual.learn=always" * (drift >= CHANGING)
        rows.append(("colours along the flow", text))
    if any(scene.offset):
        offset = ", ".join(f"{value:.12g}" for value in scene.offset)
        rows.insert(4, ("offset", f"{offset}: to be added to the box and the room for motion"))
    gap = widest_gap(scene)
    if gap is not None:
        rows.insert(2, ("static views", f"widest sector without one: {gap:.0f} degrees"))
    return rows


def _why(reason: str) -> str:
    return f" ({reason})" if reason else ""


def _times(views: Views) -> str:
    """Number and range of the times, and whether they are even to a hundredth of a step."""
    times = distinct_times(views.times)
    steps = times.diff()
    even = torch.allclose(steps, steps.mean(), rtol=0.01, atol=FrameClock.TOLERANCE)
    spacing = "" if even else "un"
    return f"{len(times)} from {float(times[0]):g} to {float(times[-1]):g}, {spacing}evenly spaced"


def image_facts(scene: Scene) -> list[Row]:
    """A row as :data:`HEADING` says for each set of images that is not empty."""
    middle = box_middle(scene)
    return [_set_facts(name, views, middle) for name, views in image_sets(scene).items()]


def _set_facts(name: str, views: Views, middle: Tensor) -> Row:
    distance = (views.cameras.positions - middle).norm(dim=1)
    near, far = map(float, distance.aminmax())
    mean = float(distance.mean())
    low, high = map(float, views.cameras.focal.aminmax())
    alpha = masked = "no"
    if views.has_alpha:
        inside = mean_share(image.pixels[0, ..., 3] > OPAQUE for image in views.singles())
        alpha = f"cover {_percent(inside)}"
    if (left_out := masked_share(views)) is not None:
        masked = f"leave out {_percent(left_out)}"
    sizes = sorted({views.cameras.size_of(k) for k in range(len(views))})
    return (
        name,
        str(len(views)),
        f"{len(set(views.view.tolist()))} x {len(distinct_times(views.times))}",
        listed([f"{width} x {height}" for width, height in sizes]),
        alpha,
        masked,
        f"{low:.0f} px" if high - low < 0.5 else f"{low:.0f} to {high:.0f} px",
        f"{mean:.3g}" if far - near < 0.01 * mean else f"{near:.3g} to {far:.3g}",
    )


def flow_facts(views: Views) -> str:
    """The valid share and the length of the optical flow of views that have a frame before them."""
    if views.flow is None:
        return "none"
    images = [image for image, _ in frame_pairs(views)]
    count = 0
    inside = 0
    covered = 0
    total = 0.0
    longest = 0.0
    pixels = 0
    for k in images:  # one by one: all of a large scene's flow at once would be copied
        view = views.single(k)
        assert view.flow is not None
        valid = view.flow.valid[0]
        length = view.flow.vectors[0][valid].norm(dim=-1)
        pixels += valid.numel()
        count += len(length)
        total += float(length.sum())
        longest = max(longest, float(length.max())) if len(length) else longest
        if views.has_alpha:
            alpha = view.pixels[0, ..., 3] > OPAQUE
            inside += int(alpha.sum())
            covered += int((alpha & valid).sum())
    share = _percent(count / max(pixels, 1))
    in_alpha = f" ({_percent(covered / max(inside, 1))} of the alpha masks)" * views.has_alpha
    return (
        f"{len(images)} images, valid on {share} of the pixels{in_alpha}, "
        f"mean {total / max(count, 1):.1f} px, longest {longest:.1f} px"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
