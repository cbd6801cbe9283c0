"""The tables of a report: runs averaged and ranked by scene, beside the paper's rows."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import pandas as pd

from devrf.apps.report.labels import labelled
from devrf.apps.report.runs import SAMPLING, Collection, number
from devrf.apps.settings import PublishedScenes

UNKNOWN = "–"


@dataclass(frozen=True)
class Column:
    """A column of the tables, and the ``key`` of its values in a collection; times in seconds.

    A value without ``digits`` is a time in the unit that reads best. Values ``of_hardware`` of
    different devices cannot be compared.
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
# Shown if a run was scored at times that no training view has; the paper has no such columns.
OF_TIMES = (
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
        hardware: of the measurements.
        credit: the source, in words.
        data: of each scene, by devrf's name of the scene.
        texts: the cells as printed, indexed by scene and label. The column ``method`` is the
            paper's own name; its "Ours" is DeVRF in the label.
        values: the same cells as numbers, the time in seconds.
    """

    hardware: str
    credit: str
    data: dict[str, dict[str, Any]]
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
    described = {scene["name"]: scene["data"] for scene in data["scenes"]}
    return Published(**data["source"], data=described, texts=texts, values=values)


@dataclass(frozen=True)
class Block:
    """The rows of one scene, or of an average over scenes.

    Both frames are indexed by label. Their columns have two levels: ``head`` has ``name``,
    ``protocol`` and ``counts`` (a set of numbers of runs averaged); ``value`` (NaN where unknown),
    ``text`` and ``rank`` (1, 2, 3 for the best, else 0) have the title of each column.
    Published rows are not ranked.
    """

    title: str
    measured: pd.DataFrame
    published: pd.DataFrame


@dataclass(frozen=True)
class Table:
    """The contents of a report.

    Attributes:
        runs: the labelled runs whose dynamic capture was scored, or of a scene at rest the static
            one.
        rows: means over runs, indexed by scene and label: ``name``, ``protocol``, ``line``,
            ``views``, ``count`` and each column's title; NaN unless all runs of the row have the
            value.
        blocks: one for each scene, then the average if there is more than one.
        gains: over three scenes or more, if they are alike: PSNR by label as text, its mean and its
            least, and its gain over the first row's; seconds as a multiple of that row's.
        notes: remarks on columns and rows, a sentence each.
    """

    collection: Collection
    columns: tuple[Column, ...]
    runs: pd.DataFrame
    rows: pd.DataFrame
    blocks: tuple[Block, ...]
    gains: pd.DataFrame
    notes: tuple[str, ...]

    @property
    def shows_published(self) -> bool:
        """Whether any row is the paper's."""
        return any(len(block.published) for block in self.blocks)


def tabulate(collection: Collection, published_scenes: PublishedScenes = "matching") -> Table:
    """The tables of a collection, beside the paper's rows of the same data, of all, or of none."""
    scored = _values(collection.runs, PSNR).notna()
    again = _scored_again(collection.runs[scored])
    runs = labelled(collection.runs[scored].drop(index=again.index))
    of_times = [c for c in OF_TIMES if c.key in runs and _values(runs, c).notna().any()]
    columns = (PSNR, *of_times, *COLUMNS[1:])
    titles = [column.title for column in columns]
    for column in columns:
        runs[column.title] = _values(runs, column)
    groups = runs.groupby(["scene", "label"], sort=False)
    described = ["name", "protocol", "line", "views", "kind"]
    heads = groups[described].first().assign(count=groups.size())
    complete = groups[titles].count().eq(heads["count"], axis=0)
    rows = heads.join(groups[titles].mean().where(complete))
    spread = groups[titles].std().where(complete)

    ours = list(runs["scene"].unique())
    same = {run["scene"] for run in runs.to_dict("records") if _is_of_published_data(run)}
    # The paper's scenes by title: they stand below runs of the same data, else alone.
    theirs = {s if s in same or s not in ours else f"{s}, published": s for s in published().data}
    if published_scenes != "all":
        theirs = {scene: scene for scene in same if published_scenes == "matching"}
    blocks: list[Block] = []
    for scene in dict.fromkeys([*ours, *theirs]):
        measured = _cells(
            _of(rows, [scene]).assign(counts=lambda row: row["count"].map(lambda n: {n})),
            _of(spread, [scene]),
            columns,
            runs.loc[runs["scene"] == scene, "run.device"],
        )
        paper = [theirs[scene]] if scene in theirs else []
        blocks.append(Block(scene, measured, _published(paper, columns)))
    gains = pd.DataFrame()
    if len(ours) > 1:
        title = f"average over {len(ours)} scenes"
        paper = ours if set(ours) <= set(theirs) else []
        average = Block(title, _average(runs, rows, ours, columns), _published(paper, columns))
        blocks += [average] if len(average.measured) else []
        if len(average.measured) > 1 and len(ours) > 2:
            gains = _gains(rows.reset_index(), average.measured)
    notes = _notes(runs, collection.runs.loc[~scored, "folder"], again)
    left_out = [scene for scene in ours if scene in published().data and scene not in theirs]
    if left_out and published_scenes == "matching":
        notes.append(
            f"Of other data than the paper's rows, which are left out: {', '.join(left_out)}."
        )
    return Table(collection, columns, runs, rows, tuple(blocks), gains, tuple(notes))


def _is_of_published_data(run: Mapping[str, Any]) -> bool:
    """Whether a run's data are said (``data=NAME``) and seen to be those of the paper's rows."""
    data = {key: run.get(f"run.{key}") for key in ("image_size", "frames", "train_views")}
    if isinstance(data["image_size"], list):
        data["image_size"] = sorted(data["image_size"])
    is_named = run.get("run.choices.data") == run["scene"]
    return is_named and data == published().data.get(run["scene"])


def _values(runs: pd.DataFrame, column: Column) -> pd.Series:
    """The values of a column, NaN where unknown; scenes at rest have those of the static set."""
    values = runs[column.key].map(number).astype(float)
    section, _, name = column.key.partition(".")
    at_rest = runs["at_rest"].eq(True)
    key = f"static.{name}"
    if section == "dynamic" and key in runs:
        values = values.where(~at_rest, runs[key].map(number).astype(float))
    return values


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


def _of(frame: pd.DataFrame, scenes: list[str]) -> pd.DataFrame:
    """The rows of some scenes, by label."""
    return frame[frame.index.get_level_values("scene").isin(scenes)].droplevel("scene")


def _cells(
    rows: pd.DataFrame,
    spread: pd.DataFrame,
    columns: Sequence[Column],
    devices: pd.Series | None,
) -> pd.DataFrame:
    """A block's rows; memory and time are ranked only if all ``devices`` agree, None ranks none."""
    titles = [column.title for column in columns]
    texts = rows[titles].astype(object)
    ranks = pd.DataFrame(0, rows.index, titles)
    for column in columns:
        both = zip(rows[column.title], spread[column.title], strict=True)
        texts[column.title] = [shown(value, column, deviation) for value, deviation in both]
        if devices is not None and (devices.nunique(dropna=False) == 1 or not column.of_hardware):
            ranks[column.title] = ranked(rows[column.title], column)
    heads = rows[["name", "protocol", "counts"]]
    parts = {"head": heads, "value": rows[titles], "text": texts, "rank": ranks}
    return pd.concat(parts, axis=1)


def _average(
    runs: pd.DataFrame, rows: pd.DataFrame, scenes: list[str], columns: Sequence[Column]
) -> pd.DataFrame:
    """Means over all scenes, if these are alike, of rows that every scene has; without spread."""
    groups = rows.groupby("label", sort=False)
    titles = [column.title for column in columns]
    means = _over_scenes(rows[titles], scenes).join(groups[["name", "protocol"]].first())
    alike = (groups.size() == len(scenes)) & (groups["kind"].nunique() == 1)
    means = means.assign(counts=groups["count"].agg(set))[alike]
    devices = runs.loc[runs["label"].isin(means.index), "run.device"]
    return _cells(means, means[titles] * math.nan, columns, devices)


def _gains(rows: pd.DataFrame, average: pd.DataFrame) -> pd.DataFrame:
    """Gains of an average's rows over its first: see :class:`Table`."""
    by_scene = rows[rows["label"].isin(average.index)].pivot(index="label", columns="scene")
    psnr = by_scene["PSNR"].reindex(average.index)
    seconds = by_scene["Time"].reindex(average.index)
    gain = psnr - psnr.iloc[0]
    first = average["head", "name"].iloc[0]
    least = zip(gain.min(axis=1), gain.idxmin(axis=1), strict=True)
    return pd.DataFrame(
        {
            "": average["head", "name"],
            "PSNR": psnr.mean(axis=1).map("{:.2f}".format),
            "PSNR, least": psnr.min(axis=1).map("{:.2f}".format),
            f"gain over {first}": gain.mean(axis=1).map("{:+.2f}".format),
            "gain, least": [f"{value:+.2f} ({scene})" for value, scene in least],
            "time": seconds.div(seconds.iloc[0]).mean(axis=1).map("{:.2f}×".format),
        }
    )


def _published(scenes: list[str], columns: Sequence[Column]) -> pd.DataFrame:
    """The paper's rows of a scene, or their means over several; empty for no scene."""
    values = _over_scenes(_of(published().values, scenes), scenes).dropna()
    values = values.reindex(columns=[column.title for column in columns])
    rows = values.assign(name=values.index, protocol="", counts=[{1} for _ in values.index])
    cells = _cells(rows, values * math.nan, columns, devices=None)
    if len(scenes) == 1:
        cells["text"] = _of(published().texts[TITLES], scenes).reindex(
            columns=values.columns, fill_value=UNKNOWN
        )
    return cells


def _over_scenes(values: pd.DataFrame, scenes: list[str]) -> pd.DataFrame:
    """Means by label; NaN unless every scene has the value."""
    groups = values.groupby("label", sort=False)
    return groups.mean().where(groups.count() == len(scenes))


def _scored_again(runs: pd.DataFrame) -> pd.Series:
    """Folders of runs whose checkpoint was scored again later, in another folder."""
    checkpointed = runs[runs["run.checkpoint"].notna()].sort_values(
        "run.date", kind="stable", na_position="first"
    )
    again = checkpointed.loc[checkpointed.duplicated("run.checkpoint", keep="last"), "folder"]
    return again.sort_index()


def _sampled(runs: pd.DataFrame) -> list[str]:
    """Sampling of the methods that can choose it, a sentence for each way."""
    absent = pd.Series(None, runs.index, dtype=object)
    kind = runs.get(SAMPLING, absent)
    hull = runs.get("run.settings.ray_stage.model.settings.hull", absent)
    # A hull of alpha masks counts with samples by occupancy only; Neural Volumes' always are.
    carved = hull.eq(True) & kind.fillna("occupancy").eq("occupancy")
    way = kind.where(kind.notna() | hull.isna(), "even steps")
    way = way.where(~carved, way.astype(str) + " within hulls of alpha masks")
    names = runs["name"].groupby(way, sort=False).unique()
    return [f"Samples by {kind}: {', '.join(methods)}." for kind, methods in names.items()]


def _scored(runs: pd.DataFrame) -> str:
    """The form of the scores, for comparison with other tables: filter, range, network."""
    networks = runs.get("run.lpips_network", pd.Series(dtype=object)).dropna().unique()
    perceptual = f" LPIPS is that of {' or '.join(sorted(networks))}, on images in [-1, 1]."
    has_lpips = len(networks) and runs[LPIPS.title].notna().any()
    return (
        "Images are made smaller by the mean over areas (OpenCV's INTER_AREA); PSNR and SSIM are "
        f"of colours in [0, 1].{perceptual if has_lpips else ''}"
    )


def _notes(runs: pd.DataFrame, at_rest: pd.Series, again: pd.Series) -> list[str]:
    notes = [
        f"No run has {column.title}: {column.why_missing}."
        for column in COLUMNS
        if len(runs) and runs[column.title].isna().all()
    ]
    if runs["run.device"].nunique(dropna=False) > 1:
        notes.append("Memory and time are marked only among rows of one device.")
    notes += _sampled(runs)
    notes += [_scored(runs)] if len(runs) else []
    for why, folders in (
        ("Scored at rest only, and therefore not in the tables", at_rest),
        ("Counted once, as last scored elsewhere with the same checkpoint", again),
    ):
        notes += [f"{why}: {', '.join(folders)}."] if len(folders) else []
    return notes
