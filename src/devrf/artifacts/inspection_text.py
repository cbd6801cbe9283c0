"""An inspection in words: rich tables for a terminal, plain text for a log."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Group, RenderableType
from rich.text import Text

from devrf.artifacts.inspection import FlowFacts, Inspection, ViewsFacts
from devrf.artifacts.sections import Section, as_lines, as_tables
from devrf.geometry.box import Box
from devrf.scenes.scene import Bounds


def sections(found: Inspection, needs: Iterable[tuple[str, int]]) -> list[Section]:
    """The whole report: the scene, its images, where it is, and what a run will need."""
    return [
        _scene(found),
        Section(
            "images",
            (
                (
                    "set",
                    "images",
                    "views x times",
                    "size",
                    "mattes",
                    "masks",
                    "focal length",
                    "distance",
                ),
                *(_images(facts) for facts in found.sets),
            ),
            heading=True,
        ),
        _memory(needs),
    ]


def plain(found: Inspection, needs: Iterable[tuple[str, int]]) -> str:
    """The report as plain text, columns aligned."""
    lines = as_lines(sections(found, needs))
    lines.append(_verdict(found))
    lines += [f"  {advice}" for advice in found.advice]
    return "\n".join(lines)


def tables(found: Inspection, needs: Iterable[tuple[str, int]]) -> RenderableType:
    """The report as tables for a terminal."""
    parts = as_tables(sections(found, needs))
    parts.append(Text(_verdict(found), style="bold yellow" if found.advice else "bold green"))
    for advice in found.advice:
        parts.append(
            Text.assemble(
                ("  " + advice.where, "yellow"), f": {advice.what}; ", (advice.remedy, "italic")
            )
        )
    return Group(*parts)


def size(count: float) -> str:
    """Bytes in the unit that reads best: 1.6 GB, 12 MB, 3 kB (powers of ten)."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            value = count / factor
            return f"{value:.1f} {unit}" if value < 10 else f"{value:.0f} {unit}"
    return f"{count:.0f} B"


def _verdict(found: Inspection) -> str:
    count = len(found.advice)
    return "no problems found" if count == 0 else f"problems found: {count}"


def _scene(found: Inspection) -> Section:
    bounds, times = found.bounds, found.times
    unit = "NDC" if found.kind == "forward" else "world units"
    spacing = "evenly spaced" if times.even else "unevenly spaced"
    rows = [
        ("scene", f"{found.name}, {found.kind}-facing, {found.background} background"),
        ("times", f"{times.count} from {times.first:g} to {times.last:g}, {spacing}"),
        ("near, far", f"{bounds.near:.4g}, {bounds.far:.4g} ({unit})"),
        ("box", _box(bounds.box)),
        ("room for motion", _room(bounds)),
        ("optical flow", _flow(found.flow)),
    ]
    if found.gap is not None:
        rows.insert(2, ("static views", f"widest sector without one: {found.gap:.0f} degrees"))
    return Section("what was found", tuple(rows))


def _room(bounds: Bounds) -> str:
    if bounds.motion is None:
        return bounds.source
    return f"{_box(bounds.motion)}, {bounds.source}"


def _box(box: Box) -> str:
    low, high = (" ".join(f"{v:.3g}" for v in corner) for corner in (box.low, box.high))
    return f"[{low}] to [{high}]"


def _flow(flow: FlowFacts | None) -> str:
    if flow is None:
        return "none"
    on_matte = ""
    if flow.valid_on_matte is not None:
        on_matte = f" ({100 * flow.valid_on_matte:.0f} % of the mattes)"
    return (
        f"{flow.images} images, valid on {100 * flow.valid:.0f} % of the pixels{on_matte}, "
        f"mean {flow.mean:.1f} px, longest {flow.longest:.1f} px"
    )


def _images(facts: ViewsFacts) -> tuple[str, ...]:
    least, most = facts.focal
    focal = f"{least:.0f} px" if most - least < 0.5 else f"{least:.0f} to {most:.0f} px"
    near, mean, far = facts.distance
    distance = f"{mean:.3g}" if far - near < 0.01 * mean else f"{near:.3g} to {far:.3g}"
    mattes = "no" if facts.mattes is None else f"cover {_percent(facts.mattes)}"
    masks = "no" if facts.left_out is None else f"leave out {_percent(facts.left_out)}"
    return (
        facts.name,
        str(facts.images),
        f"{facts.views} x {facts.frames}",
        f"{facts.width} x {facts.height}",
        mattes,
        masks,
        focal,
        distance,
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _memory(needs: Iterable[tuple[str, int]]) -> Section:
    rows = tuple((name, size(count)) for name, count in needs)
    return Section("what a run will need, estimated", rows)
