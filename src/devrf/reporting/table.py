"""The tables' contents: rows of runs averaged, ranked and put beside the paper's, by scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pandas as pd

from devrf.reporting.labels import labelled
from devrf.reporting.published import published
from devrf.reporting.runs import Collection, number
from devrf.reporting.settings import PublishedScenes

UNKNOWN = "–"


@dataclass(frozen=True)
class Column:
    """A column of the paper's tables.

    Attributes:
        title: its heading.
        key: the column of a collection that holds its value; times are in seconds.
        higher_is_better: else lower is.
        digits: after the point; None: a time in the unit that reads best.
        of_hardware: whether values of different devices cannot be compared.
        why_missing: why no run may have it.
    """

    title: str
    key: str
    higher_is_better: bool
    digits: int | None
    of_hardware: bool = False
    why_missing: str = "it was not recorded"

    @property
    def heading(self) -> str:
        """The title with the direction in which it is better."""
        return f"{self.title} {'↑' if self.higher_is_better else '↓'}"


NO_WEIGHTS = (
    "it was not asked for, or the weights that it needs were not available "
    "(evaluation.lpips_weights, evaluation.download)"
)
PSNR = Column("PSNR", "dynamic.psnr", True, 2)
SSIM = Column("SSIM", "dynamic.ssim", True, 3)
LPIPS = Column("LPIPS", "dynamic.lpips", False, 4, False, NO_WEIGHTS)
GPU = Column("GPU (GB)", "peak_gpu_gb", False, 1, True, "no run is known to have used a GPU")
TIME = Column("Time", "train_seconds", False, None, True)
COLUMNS = (PSNR, SSIM, LPIPS, GPU, TIME)
TITLES = [column.title for column in COLUMNS]


@dataclass(frozen=True)
class Block:
    """The rows of one scene, or of an average over scenes.

    Both frames are indexed by label. Their columns have two levels: ``head`` (``name``,
    ``protocol``, ``counts``: the numbers of runs averaged, as a frozenset), then ``value`` (NaN
    where unknown), ``text`` and ``rank`` (1, 2, 3 for the best, else 0), each of every title.

    Attributes:
        title: the scene's name, or what was averaged.
        measured: rows of runs, ranked among themselves.
        published: rows of the paper, not ranked.
    """

    title: str
    measured: pd.DataFrame
    published: pd.DataFrame


@dataclass(frozen=True)
class Table:
    """The contents of a report.

    Attributes:
        found: the runs and failures that it is about.
        runs: the runs whose dynamic capture was scored, labelled.
        rows: means over runs, indexed by scene and label: ``name``, ``protocol``, ``line``,
            ``views``, ``count`` and every title; NaN unless all runs of the row have the value.
        blocks: one for each scene, then the average if there is more than one.
        notes: remarks on columns and rows, a sentence each.
    """

    found: Collection
    runs: pd.DataFrame
    rows: pd.DataFrame
    blocks: tuple[Block, ...]
    notes: tuple[str, ...]

    @property
    def shows_published(self) -> bool:
        """Whether any row is the paper's."""
        return any(len(block.published) for block in self.blocks)


def tabulate(found: Collection, published_scenes: PublishedScenes = "matching") -> Table:
    """Make the tables of a collection.

    Args:
        found: finished runs and failures.
        published_scenes: which of the paper's rows stand beside them: those of the scenes that
            were run, all, or none.
    """
    scored = found.runs[PSNR.key].map(number).notna()
    runs = labelled(found.runs[scored])
    for column in COLUMNS:
        runs[column.title] = runs[column.key].map(number).astype(float)
    groups = runs.groupby(["scene", "label"], sort=False)
    heads = groups[["name", "protocol", "line", "views"]].first().assign(count=groups.size())
    complete = groups[TITLES].count().eq(heads["count"], axis=0)
    rows = heads.join(groups[TITLES].mean().where(complete))
    spread = groups[TITLES].std().where(complete)

    ours, known = list(runs["scene"].unique()), list(published().tables)
    theirs = {"none": [], "all": known, "matching": [s for s in ours if s in known]}
    blocks: list[Block] = []
    for scene in dict.fromkeys([*ours, *theirs[published_scenes]]):
        of_scene = rows.index.get_level_values("scene") == scene
        means, spreads = (frame[of_scene].droplevel("scene") for frame in (rows, spread))
        counts = [frozenset({count}) for count in means["count"]]
        devices = runs.loc[runs["scene"] == scene, "run.device"]
        measured = _measured(means.assign(counts=counts), spreads, devices)
        blocks.append(Block(scene, measured, _published(scene, theirs[published_scenes])))
    if len(ours) > 1:
        average = _average(runs, rows, ours, theirs[published_scenes])
        blocks += [average] if len(average.measured) else []
    notes = _notes(runs, found.runs.loc[~scored, "folder"])
    return Table(found, runs, rows, tuple(blocks), tuple(notes))


def shown(value: float, column: Column, spread: float = math.nan) -> str:
    """A value with the digits of its column: ``29.42``, ``29.42 ± 0.11``, ``9.2 min``, ``–``."""
    if math.isnan(value):
        return UNKNOWN
    size, digits, unit = 1.0, column.digits, ""
    if digits is None:
        if value < 99.5:
            unit, digits = " s", 0 if value >= 9.95 else 1
        elif value < 99.5 * 60:
            size, unit, digits = 60.0, " min", 1
        else:
            size, unit, digits = 3600.0, " h", 1
    text = f"{value / size:.{digits}f}"
    if not math.isnan(spread):
        text += f" ± {spread / size:.{digits}f}"
    return text + unit


def ranked(values: pd.Series, column: Column) -> pd.Series:
    """1, 2, 3 for the best values, else 0; values that look the same share a rank.

    No value is ranked where all look the same, for none is better than another.
    """
    looks = values.map(lambda value: shown(value, column)).where(values.notna())
    if looks.nunique() < 2:
        return values.mul(0).fillna(0).astype(int)
    alike = values.groupby(looks).transform("min")
    ranks = alike.rank(method="dense", ascending=not column.higher_is_better)
    return ranks.where(ranks <= 3, 0).astype(int)


def _measured(means: pd.DataFrame, spread: pd.DataFrame, devices: pd.Series) -> pd.DataFrame:
    """Cells of measured rows; memory and time are ranked only if all are of one device."""
    one_device = devices.nunique(dropna=False) == 1
    texts, ranks = means[TITLES].astype(object), means[TITLES].astype(object)
    for column in COLUMNS:
        values, spreads = means[column.title], spread[column.title]
        texts[column.title] = [
            shown(value, column, deviation)
            for value, deviation in zip(values, spreads, strict=True)
        ]
        comparable = one_device or not column.of_hardware
        ranks[column.title] = ranked(values, column) if comparable else 0
    return _cells(means[["name", "protocol", "counts"]], means[TITLES], texts, ranks)


def _published(scene: str, theirs: list[str]) -> pd.DataFrame:
    paper = published()
    scenes = [scene] if scene in theirs else []
    texts, values = (
        frame[frame.index.get_level_values("scene").isin(scenes)].droplevel("scene")
        for frame in (paper.texts[TITLES], paper.values)
    )
    return _of_paper(values, texts)


def _average(runs: pd.DataFrame, rows: pd.DataFrame, ours: list[str], theirs: list[str]) -> Block:
    """Means over all scenes of the configurations that were run on all of them.

    Without a spread: what scenes differ in is no uncertainty of a measurement.
    """
    groups = rows.groupby("label", sort=False)
    means = groups[["name", "protocol"]].first().join(_over_scenes(rows[TITLES], ours))
    means["counts"] = groups["count"].agg(frozenset)
    means = means[groups.size() == len(ours)]
    devices = runs.loc[runs["label"].isin(means.index), "run.device"]
    measured = _measured(means, means[TITLES] * math.nan, devices)

    values = published().values
    shared = values[values.index.get_level_values("scene").isin(ours)]
    if not set(ours) <= set(theirs):
        shared = shared[:0]
    paper = _over_scenes(shared, ours).dropna()
    texts = paper.astype(object)
    for column in COLUMNS:
        texts[column.title] = [shown(value, column) for value in paper[column.title]]
    return Block(f"average over {len(ours)} scenes", measured, _of_paper(paper, texts))


def _over_scenes(values: pd.DataFrame, scenes: list[str]) -> pd.DataFrame:
    """Means by label; NaN unless every scene has the value."""
    groups = values.groupby("label", sort=False)
    return groups.mean().where(groups.count() == len(scenes))


def _of_paper(values: pd.DataFrame, texts: pd.DataFrame) -> pd.DataFrame:
    heads = pd.DataFrame({"name": values.index, "protocol": ""}, index=values.index, dtype=object)
    heads["counts"] = [frozenset({1})] * len(values)
    return _cells(heads, values, texts, texts.map(lambda text: 0))


def _cells(
    heads: pd.DataFrame, values: pd.DataFrame, texts: pd.DataFrame, ranks: pd.DataFrame
) -> pd.DataFrame:
    return pd.concat({"head": heads, "value": values, "text": texts, "rank": ranks}, axis=1)


def _notes(runs: pd.DataFrame, at_rest: pd.Series) -> list[str]:
    notes = [
        f"No run has {column.title}: {column.why_missing}."
        for column in COLUMNS
        if len(runs) and runs[column.title].isna().all()
    ]
    if runs["run.device"].nunique(dropna=False) > 1:
        notes.append("Memory and time are marked only among rows of one device.")
    if len(at_rest):
        names = ", ".join(at_rest)
        notes.append(f"Scored at rest only, and therefore not in the tables: {names}.")
    return notes
