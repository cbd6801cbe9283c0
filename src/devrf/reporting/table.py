"""The table itself: scene blocks of rows and cells, whatever it is written as."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean
from typing import Literal

from devrf.reporting.columns import COLUMNS, UNKNOWN, Cell, Column, cell, ranked, shown
from devrf.reporting.published import published
from devrf.reporting.rows import RowOfRuns, rows_of
from devrf.reporting.runs import Collection

PublishedScenes = Literal["matching", "all", "none"]


@dataclass(frozen=True)
class Row:
    """A row.

    Attributes:
        label: the method.
        cells: one for each of the columns.
        seeds: how many runs its values are means of; more than one number where scenes differ.
    """

    label: str
    cells: tuple[Cell, ...]
    seeds: frozenset[int] = frozenset({1})


@dataclass(frozen=True)
class Block:
    """The rows of one scene, or of an average over scenes.

    Attributes:
        title: the scene's name, or what was averaged.
        measured: rows of runs, ranked among themselves.
        published: rows of the paper, not ranked.
    """

    title: str
    measured: tuple[Row, ...]
    published: tuple[Row, ...]


@dataclass(frozen=True)
class Table:
    """What a report says.

    Attributes:
        found: the runs and failures that it is about.
        rows: the runs whose motion was scored, as they are put into rows.
        blocks: one for each scene, then the average if there is more than one.
        notes: what a reader must know of columns and rows, a sentence each.
    """

    found: Collection
    rows: tuple[RowOfRuns, ...]
    blocks: tuple[Block, ...]
    notes: tuple[str, ...]

    @property
    def shows_published(self) -> bool:
        """Whether any row is the paper's."""
        return any(block.published for block in self.blocks)


def tabulate(found: Collection, published_scenes: PublishedScenes = "matching") -> Table:
    """Make the table of what was found.

    Args:
        found: finished runs and failures.
        published_scenes: which of the paper's rows stand beside them: those of the scenes that
            were run, all, or none.
    """
    rows = rows_of([run for run in found.runs if run.moving])
    ours = list(dict.fromkeys(row.scene for row in rows))
    theirs = [] if published_scenes == "none" else list(published().scenes)
    if published_scenes == "matching":
        theirs = [scene for scene in ours if scene in theirs]
    blocks = [
        Block(scene, _scene([row for row in rows if row.scene == scene]), _paper(scene, theirs))
        for scene in dict.fromkeys([*ours, *theirs])
    ]
    if len(ours) > 1:
        title = f"average over {len(ours)} scenes"
        block = Block(title, _average(rows, len(ours)), _paper_average(ours, theirs))
        blocks += [block] if block.measured else []
    return Table(found, tuple(rows), tuple(blocks), tuple(_notes(found, rows)))


def _scene(rows: Sequence[RowOfRuns]) -> tuple[Row, ...]:
    """The measured rows of one scene."""
    return _marked([[row] for row in rows], [[_cell_of(row, c) for row in rows] for c in COLUMNS])


def _average(rows: Sequence[RowOfRuns], scenes: int) -> tuple[Row, ...]:
    """Means over all scenes of the configurations that were run on all of them."""
    groups = [
        [same for same in rows if same.identity == identity]
        for identity in dict.fromkeys(row.identity for row in rows)
    ]
    groups = [group for group in groups if len(group) == scenes]
    columns = [
        [_mean([_cell_of(row, column).value for row in group], column) for group in groups]
        for column in COLUMNS
    ]
    return _marked(groups, columns)


def _cell_of(row: RowOfRuns, column: Column) -> Cell:
    return cell([column.of(run) for run in row.runs], column)


def _mean(values: Sequence[float | None], column: Column) -> Cell:
    """The mean over scenes; what scenes differ in is no spread of a measurement."""
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return Cell(None, UNKNOWN)
    return Cell(mean(known), shown(mean(known), column))


def _marked(
    groups: Sequence[Sequence[RowOfRuns]], columns: Sequence[Sequence[Cell]]
) -> tuple[Row, ...]:
    """A row for each group of rows, from columns of cells, marked where they can be compared."""
    one_device = len(_devices([row for group in groups for row in group])) == 1
    marked = [
        ranked(cells, column) if one_device or not column.of_hardware else cells
        for cells, column in zip(columns, COLUMNS, strict=True)
    ]
    return tuple(
        Row(group[0].label, cells, frozenset(len(row.runs) for row in group))
        for group, cells in zip(groups, zip(*marked, strict=True), strict=True)
    )


def _devices(rows: Sequence[RowOfRuns]) -> set[str | None]:
    return {run.text("run.device") for row in rows for run in row.runs}


def _paper(scene: str, theirs: Sequence[str]) -> tuple[Row, ...]:
    rows = published().scenes[scene] if scene in theirs else ()
    return tuple(Row(row.label, tuple(map(Cell, row.values, row.texts))) for row in rows)


def _paper_average(scenes: Sequence[str], theirs: Sequence[str]) -> tuple[Row, ...]:
    """Means of the paper's numbers over the same scenes, if it has all of them."""
    if not set(scenes) <= set(theirs):
        return ()
    tables = [{row.label: row.values for row in published().scenes[scene]} for scene in scenes]
    return tuple(
        Row(
            label,
            tuple(
                _mean([table[label][k] for table in tables], column)
                for k, column in enumerate(COLUMNS)
            ),
        )
        for label in tables[0]
        if all(label in table for table in tables)
    )


def _notes(found: Collection, rows: Sequence[RowOfRuns]) -> list[str]:
    notes: list[str] = []
    for column in COLUMNS:
        if rows and not any(column.of(run) is not None for row in rows for run in row.runs):
            notes.append(f"No run has {column.title}: {column.why_missing}.")
    if len(_devices(rows)) > 1:
        notes.append("Memory and time are marked only among rows of one device.")
    still = [run for run in found.runs if not run.moving]
    if still:
        names = ", ".join(run.name for run in still)
        notes.append(f"Scored at rest only, and therefore not in the tables: {names}.")
    return notes
