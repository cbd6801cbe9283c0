"""An inspection as text: tables of facts, and a line for each piece of advice."""

from __future__ import annotations

import io
from collections.abc import Sequence

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from devrf.apps.inspection.report import FlowFacts, Inspection, ViewsFacts
from devrf.data.color_change import CHANGING
from devrf.scenes.scene import Scene

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
    if not scene.space.straight:
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
