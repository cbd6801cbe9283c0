"""What a benchmark has found, as plain data with the units in its names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from devrf.cli.timing import PictureTiming, Spread, Timing


@dataclass(frozen=True)
class Benchmark:
    """How fast a scene is learned and shown on a device.

    Attributes:
        scene: its name.
        state: where the fields came from.
        copy_speed: bytes a second that the device copies, read and written.
        product_speed: floating-point operations a second of its matrix products.
        training: what an iteration takes at each resolution, coarse to fine, by implementation.
        pictures: what a picture takes, by the way of rendering.
        notes: what was not measured, and why.
    """

    scene: str
    state: str
    copy_speed: float
    product_speed: float
    training: Mapping[str, Sequence[Timing]]
    pictures: Mapping[str, PictureTiming]
    notes: tuple[str, ...]

    @property
    def rows(self) -> list[tuple[str, Timing]]:
        """Each timing with its implementation, those of one resolution side by side."""
        kinds = list(self.training)
        together = zip(*self.training.values(), strict=True)
        return [pair for timings in together for pair in zip(kinds, timings, strict=True)]

    def floor(self, timing: Timing) -> float | None:
        """Seconds that the least work of an iteration takes at the device's speeds."""
        work = timing.work
        return None if work is None else work.seconds(self.copy_speed, self.product_speed)


def as_data(found: Benchmark) -> dict[str, Any]:
    """All of it, for a JSON file."""
    return {
        "scene": found.scene,
        "state": found.state,
        "device": {
            "copy_gb_per_s": _rounded(found.copy_speed / 1e9),
            "product_gflop_per_s": _rounded(found.product_speed / 1e9),
        },
        "training": [{"kernels": kind, **_iteration(found, timing)} for kind, timing in found.rows],
        "rendering": [
            {
                "kernels": kind,
                "width": timing.width,
                "height": timing.height,
                "views": timing.views,
                "new_time_ms": _ms(timing.new),
                "same_time_ms": _ms(timing.again),
                "new_time_frames_per_s": _rounded(1 / timing.new.median),
                "same_time_frames_per_s": _rounded(1 / timing.again.median),
                "largest_difference": timing.difference,
            }
            for kind, timing in found.pictures.items()
        ],
        "notes": list(found.notes),
    }


def _iteration(found: Benchmark, timing: Timing) -> dict[str, Any]:
    data: dict[str, Any] = {
        "stage": timing.stage,
        "phase": timing.phase,
        "resolution": list(timing.resolution),
        "frames": list(timing.frames),
        "rays": timing.rays,
        "iterations": timing.iterations,
        "ms": _ms(timing.seconds),
        "iterations_per_s": _rounded(1 / timing.seconds.median),
        "measured_ms": _ms(timing.measured_seconds),
        "parts_ms": {part: _ms(spread) for part, spread in timing.parts.items()},
        "samples": {name: round(count, 1) for name, count in timing.counts.items()},
        "floor": None,
        "allocated_gb": _gib(timing.allocated),
        "reserved_gb": _gib(timing.reserved),
    }
    work, floor = timing.work, found.floor(timing)
    if work is not None and floor is not None:
        data["floor"] = {
            "mb": _rounded(work.bytes / 1e6),
            "gflop": _rounded(work.operations / 1e9),
            "ms": _rounded(1000 * floor),
            "share": _rounded(floor / timing.seconds.median),
            "achieved_gb_per_s": _rounded(work.bytes / 1e9 / timing.seconds.median),
        }
    return data


def _ms(spread: Spread) -> dict[str, float]:
    """A spread in milliseconds."""
    values = {"median": spread.median, "low": spread.low, "high": spread.high}
    return {name: _rounded(1000 * value) for name, value in values.items()}


def _gib(count: int | None) -> float | None:
    return None if count is None else round(count / 2**30, 3)


def _rounded(value: float) -> float:
    """To four digits that mean something."""
    return float(f"{value:.4g}")
