"""Columns and cells: what is shown of a run, with how many digits, and which values are best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import mean, stdev

from devrf.reporting.runs import Run

UNKNOWN = "–"


@dataclass(frozen=True)
class Column:
    """A column of the paper's tables.

    Attributes:
        title: its heading.
        higher_is_better: else lower is.
        digits: after the point; None: a time in the unit that reads best.
        of: the value of a run, None where unknown. Times are in seconds.
        of_hardware: whether values of different devices cannot be compared.
        why_missing: what to say when no run has it.
    """

    title: str
    higher_is_better: bool
    digits: int | None
    of: Callable[[Run], float | None]
    of_hardware: bool
    why_missing: str


PSNR = Column(
    "PSNR", True, 2, lambda run: run.number("deformation.psnr"), False, "it was not recorded"
)
SSIM = Column(
    "SSIM", True, 3, lambda run: run.number("deformation.ssim"), False, "it was not recorded"
)
LPIPS = Column(
    "LPIPS",
    False,
    4,
    lambda run: run.number("deformation.lpips"),
    False,
    "it was not asked for, or the weights that it needs were not at hand "
    "(evaluation.lpips_weights, evaluation.download)",
)
GPU = Column(
    "GPU (GB)", False, 1, lambda run: run.gpu_gb, True, "no run is known to have used a GPU"
)
TIME = Column("Time", False, None, lambda run: run.seconds, True, "it was not recorded")
COLUMNS = (PSNR, SSIM, LPIPS, GPU, TIME)


@dataclass(frozen=True)
class Cell:
    """A cell.

    Attributes:
        value: its number; None where unknown.
        text: as it is shown.
        rank: 1, 2, 3 for the best three values of its column within a block, else None.
    """

    value: float | None
    text: str
    rank: int | None = None


def cell(values: Sequence[float | None], column: Column) -> Cell:
    """The mean of what several seeds came to, ± their standard deviation.

    Unknown unless every seed has a value: a mean of fewer would not be what the row says.
    """
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return Cell(None, UNKNOWN)
    centre = mean(known)
    return Cell(centre, shown(centre, column, stdev(known) if len(known) > 1 else None))


def shown(value: float, column: Column, spread: float | None = None) -> str:
    """A value with the digits of its column: ``29.42``, ``29.42 ± 0.11``, ``9.2 min``."""
    size, digits, unit = 1.0, column.digits, ""
    if digits is None:
        if value < 99.5:
            unit, digits = " s", 0 if value >= 9.95 else 1
        elif value < 99.5 * 60:
            size, unit, digits = 60.0, " min", 1
        else:
            size, unit, digits = 3600.0, " h", 1
    text = f"{value / size:.{digits}f}"
    if spread is not None:
        text += f" ± {spread / size:.{digits}f}"
    return text + unit


def ranked(cells: Sequence[Cell], column: Column) -> list[Cell]:
    """Mark the best, second and third value; values that look the same share a mark."""
    looks = {shown(c.value, column): c.value for c in cells if c.value is not None}
    ordered = sorted(looks, key=lambda text: looks[text], reverse=column.higher_is_better)
    if len(ordered) < 2:  # nothing to be better than
        return list(cells)
    ranks = {text: k for k, text in enumerate(ordered[:3], start=1)}
    return [
        c if c.value is None else replace(c, rank=ranks.get(shown(c.value, column))) for c in cells
    ]
