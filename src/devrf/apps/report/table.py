"""The tables of a report: runs averaged and ranked by scene, beside the paper's rows."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import repeat
from operator import add
from typing import NamedTuple

import pandas as pd

from devrf.apps.report.labels import identity_columns, labelled
from devrf.apps.report.runs import Collection, number
from devrf.errors import DevrfError

UNKNOWN = "–"
# Keys that a note names of those in which rows of one name differ.
MOST_DIFFERENCES = 3
# What scores depend on: the protocol; of the held-out images size, number, and what is left out.
OF_SCORES = ("run.benchmark", "run.image_size", "run.test_frames", "run.exposure")


@dataclass(frozen=True)
class Column:
    """A column of the tables, and the ``key`` of its values in a collection; times in seconds.

    A value without ``digits`` is a time in the unit that reads best. Values compare only among runs
    of a scene that agree in the columns ``alike`` of the collection.
    """

    title: str
    key: str
    higher_is_better: bool
    digits: int | None
    alike: tuple[str, ...] = OF_SCORES
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
LPIPS = Column("LPIPS", "dynamic.lpips", False, 4, (*OF_SCORES, "run.lpips_network"), NO_WEIGHTS)
NO_GPU = "no run is known to have used a GPU"
GPU = Column("GPU (GB)", "peak_gpu_gb", False, 1, ("run.device",), NO_GPU)
TIME = Column("Time", "train_seconds", False, None, ("run.device",))
COLUMNS = (PSNR, SSIM, LPIPS, GPU, TIME)
TITLES = [column.title for column in COLUMNS]
# Shown if a run was scored on what moves, or at times that no training view has; the paper has no
# such columns.
FURTHER = (
    Column("PSNR moving", "dynamic.psnr_moving", True, 2, (*OF_SCORES, "run.motion_masks")),
    Column("PSNR at training times", "dynamic.training_times.psnr", True, 2),
    Column("PSNR at novel times", "dynamic.novel_times.psnr", True, 2),
)
# The form of a time below so many seconds: the unit's seconds, digits, the unit.
TIMES = (
    (9.95, 1, 1, " s"),
    (99.5, 1, 0, " s"),
    (99.5 * 60, 60, 1, " min"),
    (math.inf, 3600, 1, " h"),
)


@dataclass(frozen=True)
class Published:
    """Results that the paper reports, and their source.

    Attributes:
        benchmark: the protocol of the measurements, and its version.
        hardware: of the measurements.
        credit: the source, in words.
        texts: the cells as printed, indexed by scene and label. The column ``method`` is the
            paper's own name; its "Ours" is DeVRF in the label.
        values: the same cells as numbers, the time in seconds.
    """

    benchmark: str
    hardware: str
    credit: str
    texts: pd.DataFrame
    values: pd.DataFrame


@cache
def published() -> Published:
    """The paper's rows, from ``published.toml``."""
    data = tomllib.loads(files(__package__).joinpath("published.toml").read_text("utf-8"))
    rows = [(scene["name"], *row) for scene in data["scenes"] for row in scene["rows"]]
    texts = pd.DataFrame(rows, columns=["scene", "method", *TITLES], dtype=object)
    label = texts["method"].str.replace(r" \[\d+\]", "", regex=True).str.replace("Ours", "DeVRF")
    texts = texts.assign(label=label).set_index(["scene", "label"])
    values = texts[TITLES].assign(Time=texts["Time"].str.extract(r"([\d.]+)")[0]).astype(float)
    values["Time"] *= texts["Time"].str.endswith("hrs").map({True: 3600.0, False: 60.0})
    return Published(**data["source"], texts=texts, values=values)


class Cell(NamedTuple):
    """A value as text, and its rank: 1, 2, 3 for the best, else 0."""

    text: str
    rank: int = 0


@dataclass(frozen=True)
class Block:
    """The rows of one scene, or of an average over scenes.

    ``cells`` has a :class:`Cell` by the row's name and the column's heading: measured rows, then
    the paper's, whose names have a † and whose cells have no rank.
    """

    title: str
    cells: pd.DataFrame


@dataclass(frozen=True)
class Table:
    """The contents of a report.

    Attributes:
        runs: the labelled runs whose dynamic capture was scored, or of a scene at rest the static
            one.
        rows: means over runs, indexed by scene and label: ``views``, ``count`` and each column's
            title; NaN unless all runs of the row have the value.
        published: the scenes whose data are those of the paper's rows.
        blocks: one for each scene, then the average if there is more than one, then the gains over
            three scenes or more, if they are alike and PSNR compares: PSNR, its mean and its least,
            and its gain over the first row's; seconds as a multiple of that row's.
        notes: remarks on columns and rows, a sentence each.
    """

    collection: Collection
    runs: pd.DataFrame
    rows: pd.DataFrame
    published: frozenset[str]
    blocks: tuple[Block, ...]
    notes: tuple[str, ...]


def tabulate(collection: Collection) -> Table:
    """The tables of a collection, beside the paper's rows of the same data."""
    found = collection.runs
    scored = _values(found, PSNR).notna()
    # Those whose checkpoint was scored again later, in another folder.
    dated = found[scored].sort_values("run.date", kind="stable", na_position="first")
    again = dated[dated["run.checkpoint"].notna() & dated.duplicated("run.checkpoint", keep="last")]
    runs = labelled(found[scored].drop(index=again.index))
    further = [column for column in FURTHER if _values(runs, column).notna().any()]
    columns = (PSNR, *further, *COLUMNS[1:])
    titles = [column.title for column in columns]
    runs = runs.assign(**{column.title: _values(runs, column) for column in columns})
    groups = runs.groupby(["scene", "label", "identity"], sort=False)
    heads = groups[["views", "kind"]].first().assign(count=groups.size())
    complete = groups[titles].count().eq(heads["count"], axis=0)
    rows = heads.join(groups[titles].mean().where(complete)).droplevel("identity")
    spread = groups[titles].std().where(complete).droplevel("identity")

    _check_benchmarks(runs)
    scenes = list(runs["scene"].unique())
    papers = {*published().texts.index.get_level_values("scene")}
    same = {*runs.loc[runs["run.benchmark"] == published().benchmark, "scene"]} & papers
    blocks: list[Block] = []
    notes = _notes(runs) + _incomparable(runs, columns)
    for scene in scenes:
        of_scene = runs[runs["scene"] == scene]
        cells = [_cells(rows.loc[scene], spread.loc[scene], columns, of_scene)]
        if scene in same:
            cells.append(_published_cells(scene, columns))
        blocks.append(Block(scene, pd.concat(cells)))
    average = _average(rows, scenes, titles)
    if len(scenes) > 1 and len(average):
        averaged = runs[runs["label"].isin(average.index)]
        measured = _cells(average, average[titles] * math.nan, columns, averaged)
        blocks.append(Block(f"average over {len(scenes)} scenes", measured))
        if len(average) > 1 and len(scenes) > 2 and not _differing(averaged, PSNR):
            blocks.append(Block("gains over all scenes", _gains(rows.reset_index(), average)))
    left_out = [scene for scene in scenes if scene in papers - same]
    for why, names in (
        ("Scored at rest only, and therefore not in the tables", found[~scored]["folder"]),
        ("Counted once, as last scored elsewhere with the same checkpoint", again["folder"]),
        (f"The paper's rows are of benchmark {published().benchmark}, and left out", left_out),
    ):
        notes += [f"{why}: {', '.join(names)}."] if len(names) else []
    return Table(collection, runs, rows, frozenset(same), tuple(blocks), tuple(notes))


def _values(runs: pd.DataFrame, column: Column) -> pd.Series:
    """The values of a column, NaN where unknown; scenes at rest have those of the static set."""
    section, _, name = column.key.partition(".")
    keys = [column.key, f"static.{name}" if section == "dynamic" else column.key]
    own, at_rest = (runs.reindex(columns=[key])[key].map(number).astype(float) for key in keys)
    return own.where(~runs["at_rest"].eq(True), at_rest)


def _check_benchmarks(runs: pd.DataFrame) -> None:
    """DevrfError if the runs of a scene follow different protocols of benchmarks."""
    for scene, same in runs[runs["run.benchmark"].notna()].groupby("scene", sort=False):
        first = same.drop_duplicates("run.benchmark")
        if len(first) > 1:
            pairs = zip(first["run.benchmark"], first["folder"], strict=True)
            which = " and ".join(f"{benchmark} ({folder})" for benchmark, folder in pairs)
            raise DevrfError(
                f"report.runs: {scene} was scored as benchmarks {which}, which are no rows of one "
                "table; put their runs into folders of their own, and report on each"
            )


def _differing(runs: pd.DataFrame, column: Column) -> list[str]:
    """The columns, of those ``alike``, in which runs of one scene that have values differ."""
    having = runs[runs[column.title].notna()]
    texts = having.reindex(columns=column.alike).astype(object).fillna("none").map(str)
    return [key for key in texts if (texts[key].groupby(having["scene"]).nunique() > 1).any()]


def _incomparable(runs: pd.DataFrame, columns: Sequence[Column]) -> list[str]:
    """The columns of scenes in which nothing is marked, and in what their runs differ."""
    scenes: dict[str, list[str]] = {}
    for scene, same in runs.groupby("scene", sort=False):
        unmarked: dict[str, list[str]] = {}
        for column in columns:
            for key in _differing(same, column):
                unmarked.setdefault(key, []).append(column.title)
        for key, titles in unmarked.items():
            differ = "; ".join(same[key].fillna("none").map(str).unique())
            what = key.removeprefix("run.").replace("_", " ")
            text = f"no comparison of {', '.join(titles)}: the runs differ in {what} ({differ})."
            scenes.setdefault(text, []).append(str(scene))
    return [f"{', '.join(names)}: {text}" for text, names in scenes.items()]


def shown(value: float, column: Column, spread: float = math.nan) -> str:
    """A value with the digits of its column: ``29.42``, ``29.42 ± 0.11``, ``9.2 min``, ``–``."""
    if math.isnan(value):
        return UNKNOWN
    size = 1
    digits = column.digits
    unit = ""
    if digits is None:
        _, size, digits, unit = next(row for row in TIMES if value < row[0])
    text = f"{value / size:.{digits}f}"
    if not math.isnan(spread):
        text += f" ± {spread / size:.{digits}f}"
    return text + unit


def ranked(values: pd.Series, column: Column) -> pd.Series:
    """1, 2, 3 for the best, else 0: values with one text share a rank; no rank where all do."""
    texts = values.map(lambda value: shown(value, column)).where(values.notna())
    ranks = values.groupby(texts).transform("min")
    ranks = ranks.rank(method="dense", ascending=not column.higher_is_better)
    return ranks.where((ranks <= 3) & (texts.nunique() > 1), 0).astype(int)


def _cells(
    rows: pd.DataFrame, spread: pd.DataFrame, columns: Sequence[Column], runs: pd.DataFrame
) -> pd.DataFrame:
    """A block's measured rows; a column has ranks only if its values of all ``runs`` compare."""
    cells = {}
    for column in columns:
        values = rows[column.title]
        ranks = ranked(values, column) * (not _differing(runs, column))
        texts = map(shown, values, repeat(column), spread[column.title])
        cells[column.heading] = list(map(Cell, texts, ranks))
    # The number of runs that a row's values are means of, if it is more than one.
    many = [f" (n = {count})" * (count > 1) for count in rows["count"]]
    return pd.DataFrame(cells, index=map(add, rows.index, many))


def _published_cells(scene: str, columns: Sequence[Column]) -> pd.DataFrame:
    """The paper's rows of a scene, as printed."""
    texts = published().texts.loc[scene]
    cells = texts.reindex(columns=[column.title for column in columns], fill_value=UNKNOWN)
    cells.columns = [column.heading for column in columns]
    return cells.map(Cell).rename(index="† {}".format)


def _average(rows: pd.DataFrame, scenes: list[str], titles: list[str]) -> pd.DataFrame:
    """Means over all scenes, if these are alike, of rows that every scene has."""
    groups = rows.reset_index().groupby("label", sort=False)
    # Nor of a name that several rows of a scene have.
    alike = (groups["scene"].nunique() == len(scenes)) & (groups.size() == len(scenes))
    alike &= groups["kind"].nunique() == 1
    means = groups[titles].agg(lambda values: values.mean(skipna=False))[alike]
    return means.assign(count=1)


def _gains(rows: pd.DataFrame, average: pd.DataFrame) -> pd.DataFrame:
    """Gains of an average's rows over its first: see :class:`Table`."""
    by_scene = rows[rows["label"].isin(average.index)].pivot(index="label", columns="scene")
    psnr, seconds = (by_scene[title].reindex(average.index) for title in ("PSNR", "Time"))
    gain = psnr - psnr.iloc[0]
    least = zip(gain.min(axis=1), gain.idxmin(axis=1), strict=True)
    times = seconds.div(seconds.iloc[0]).mean(axis=1, skipna=False)
    texts = pd.DataFrame(
        {
            "PSNR": psnr.mean(axis=1).map("{:.2f}".format),
            "PSNR, least": psnr.min(axis=1).map("{:.2f}".format),
            "gain over the first": gain.mean(axis=1).map("{:+.2f}".format),
            "gain, least": [f"{value:+.2f} ({scene})" for value, scene in least],
            "time": [UNKNOWN if math.isnan(value) else f"{value:.2f}×" for value in times],
        }
    )
    return texts.map(Cell).rename_axis(None)


def _differences(runs: pd.DataFrame) -> Iterator[str]:
    """The values in which rows of one name differ, in the rows' order."""
    for (scene, label), same in runs.groupby(["scene", "label"], sort=False):
        rows = same.drop_duplicates("identity").reindex(columns=identity_columns(runs)).map(str)
        varied = [key for key in rows if rows[key].nunique() > 1]
        texts = [f"{key} ({'; '.join(rows[key])})" for key in varied[:MOST_DIFFERENCES]]
        texts += ["others"] * (len(varied) > MOST_DIFFERENCES)
        if texts:
            yield f"{scene}: the rows called {label} differ in {', '.join(texts)}."


def _notes(runs: pd.DataFrame) -> list[str]:
    """Columns without values, rows of one name, and the form of the scores."""
    if not len(runs):
        return []
    notes = [
        f"No run has {column.title}: {column.why_missing}."
        for column in COLUMNS
        if runs[column.title].isna().all()
    ]
    notes += _differences(runs)
    networks = sorted(runs["run.lpips_network"].dropna().unique())
    perceptual = f" LPIPS is that of {' or '.join(networks)}, on images in [-1, 1]."
    has_lpips = len(networks) and runs[LPIPS.title].notna().any()
    notes.append(
        "Images are made smaller by the mean over areas (OpenCV's INTER_AREA); PSNR and SSIM are "
        f"of colours in [0, 1].{perceptual if has_lpips else ''}"
    )
    return notes
