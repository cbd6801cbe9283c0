"""A benchmark in words: rich tables for a terminal, plain text for a log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

from rich.console import Group, RenderableType
from rich.filesize import decimal
from rich.text import Text

from devrf.artifacts.tables import as_text, titled_table
from devrf.cli.benchmark_record import Benchmark
from devrf.cli.timing import Spread, Timing
from devrf.system.profiling import OVERHEAD, Count, Part


def plain(found: Benchmark) -> str:
    """The report as plain text, columns aligned."""
    return as_text(tables(found))


def tables(found: Benchmark) -> RenderableType:
    """What was measured: the device, the time of an iteration, its work, and held-out views."""
    copies, products = found.copy_speed / 1e9, found.product_speed / 1e9
    measured = [
        ("scene", found.scene),
        ("fields", found.state),
        ("device", f"copies {copies:.3g} GB/s, multiplies at {products:.3g} GFLOP/s"),
    ]
    times, work, pictures = _times(found), _work(found), _pictures(found)
    return Group(
        titled_table("what was measured", measured),
        titled_table("milliseconds an iteration", times[1:], times[0]),
        titled_table("samples an iteration, and the least it has to do", work[1:], work[0]),
        titled_table("held-out views", pictures[1:], pictures[0]),
        *(Text(note, style="italic") for note in found.notes),
    )


def _times(found: Benchmark) -> list[tuple[str, ...]]:
    parts = [
        part
        for part in (*get_args(Part), OVERHEAD)
        if any(part in timing.parts for _, timing in found.rows)
    ]
    rows = [("", "grid", "kernels", "all", "lowest, highest", *parts)]
    for kind, timing in found.rows:
        spent = timing.seconds
        extremes = f"{_ms(spent.low)}, {_ms(spent.high)}"
        split = [_part(timing.parts, part) for part in parts]
        rows.append((_name(timing), _grid(timing), kind, _ms(spent.median), extremes, *split))
    return rows


def _work(found: Benchmark) -> list[tuple[str, ...]]:
    names = get_args(Count)
    gpu = any(timing.allocated is not None for _, timing in found.rows)
    rows = [
        (
            "",
            "grid",
            "kernels",
            "it/s",
            "rays",
            *names,
            "moved",
            "GB/s",
            "share of the floor",
            *(("GPU memory", "reserved") if gpu else ()),
        )
    ]
    for kind, timing in found.rows:
        memory = (_bytes(timing.allocated), _bytes(timing.reserved)) if gpu else ()
        rows.append(
            (
                _name(timing),
                _grid(timing),
                kind,
                f"{1 / timing.seconds.median:.3g}",
                str(timing.rays),
                *(_count(timing.counts, name) for name in names),
                *_floor(found, timing),
                *memory,
            )
        )
    return rows


def _floor(found: Benchmark, timing: Timing) -> tuple[str, str, str]:
    """Bytes that have to be moved, how fast they are, and the floor's share of the time."""
    floor, seconds = found.floor(timing), timing.seconds.median
    if timing.work is None or floor is None:
        return "-", "-", "-"
    moved = timing.work.bytes
    return decimal(round(moved)), f"{moved / 1e9 / seconds:.3g}", f"{100 * floor / seconds:.0f} %"


def _pictures(found: Benchmark) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [
        (
            "kernels",
            "size",
            "frames/s, each another time",
            "frames/s, same time",
            "largest difference",
        )
    ]
    for kind, timing in found.pictures.items():
        rows.append(
            (
                kind,
                f"{timing.width} x {timing.height}",
                f"{1 / timing.new.median:.3g}",
                f"{1 / timing.again.median:.3g}",
                f"{timing.difference:.1g}",
            )
        )
    return rows


def _name(timing: Timing) -> str:
    together = f", {len(timing.frames)} frames" if len(timing.frames) > 1 else ""
    return f"{timing.stage}, {timing.phase}{together}"


def _grid(timing: Timing) -> str:
    return "x".join(str(points) for points in timing.resolution)


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.3g}"


def _part(parts: Mapping[str, Spread], name: str) -> str:
    return _ms(parts[name].median) if name in parts else "-"


def _count(counts: Mapping[str, float], name: str) -> str:
    return f"{counts[name]:.0f}" if name in counts else "-"


def _bytes(count: int | None) -> str:
    return "-" if count is None else decimal(count)
