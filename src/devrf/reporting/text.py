"""What every form of the report says in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from devrf.reporting.columns import COLUMNS, Column
from devrf.reporting.published import published
from devrf.reporting.runs import Collection
from devrf.reporting.table import Table


def heading(column: Column) -> str:
    """A column's title with the direction in which it is better."""
    return f"{column.title} {'↑' if column.higher_is_better else '↓'}"


def headings() -> list[str]:
    """The columns' headings."""
    return [heading(column) for column in COLUMNS]


def valid_mask(seeds: Iterable[int]) -> str:
    """How many seeds a row's values are means of, in parentheses; nothing where it is one."""
    counts = sorted(set(seeds))
    return "" if counts == [1] else f" (n = {', '.join(map(str, counts))})"


def caption(table: Table) -> str:
    """What the measured numbers are, and which are marked; without the marks' own names."""
    devices = [run.text("run.device") for row in table.rows for run in row.runs]
    known = list(dict.fromkeys(device for device in devices if device))
    where = f" on {', '.join(known)}" if known else ""
    seeds = any(len(row.runs) > 1 for row in table.rows)
    spread = " ± is the standard deviation over n seeds." if seeds else ""
    return (
        f"Measured{where}: means over the held-out images of the moving scene; peak GPU memory "
        "and wall-clock time of optimisation, both stages together."
        f"{spread} Marks are within a scene, among measured rows; values that look the same share "
        "a mark."
    )


def credit() -> str:
    """Where the published rows come from and what they are not."""
    paper = published()
    return (
        f"As published in {paper.authors}: {paper.title}. {paper.venue}; measured by its authors "
        f"on an {paper.hardware}, other hardware than ours, and not marked. What they call Ours "
        "is DeVRF here."
    )


def published_heading() -> str:
    """What stands above published rows."""
    return f"† published, on an {published().hardware}"


def reasons(found: Collection) -> list[str]:
    """Which runs failed, and why, a line each; overrides that all runs share are left out."""
    setups = [run.setup for run in found.runs] + [lost.setup for lost in found.failures]
    told = [set(setup.overrides) for setup in setups]
    shared = set.intersection(*told) if len(told) > 1 else set()
    lines: list[str] = []
    for failure in found.failures:
        own = [text for text in failure.setup.overrides if text not in shared]
        what = " ".join([failure.scene or "unknown scene", *own])
        fault = " (a fault of the program: see its run.log)" if failure.mistake is False else ""
        lines.append(f"{failure.name} ({what}): {failure.error}{fault}")
    return lines


def aligned(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Cells of text, the columns filled up to one width: the first to the left, others right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        [
            text.rjust(width) if k else text.ljust(width)
            for k, (text, width) in enumerate(zip(row, widths, strict=True))
        ]
        for row in rows
    ]
