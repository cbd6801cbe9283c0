"""Which runs stand in one row of a table, and what the row is called.

Runs of one scene share a row only if they differ in nothing but the seed. What tells rows apart
becomes part of their label, and nothing else does.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from devrf.reporting.runs import Run

# As the paper's tables call them, in their order.
ABLATIONS = {
    "base": "Ours (base)",
    "c2f": "Ours w/ c2f",
    "c2f_tv": "Ours w/ c2f, tv",
    "c2f_tv_cycle": "Ours w/ c2f, tv, cycle",
    "full": "Ours w/ c2f, tv, cycle, flow",
}

# Groups and keys that say how a run is watched, not what it learns.
WATCHING = {"logger", "callbacks", "video", "report", "hydra"}
NOT_OF_A_ROW = {"objective", "seed", "stage"}

# What tells rows apart, most telling first; then other groups and overrides by name.
ALWAYS = ("ablation", "folder")
FIRST = ("views", "experiment", "schedule", "field", "sampling", "loss")
LAST = ("images", "device", "revision", "version")

Traits = Mapping[str, str]
Identity = tuple[str | None, ...]


@dataclass(frozen=True)
class RowOfRuns:
    """Runs of one scene and one configuration.

    Attributes:
        scene: the scene's name.
        label: what the row is called; two rows of a scene never share one.
        method: the label without the number of views.
        identity: what tells rows apart, the same for one configuration on any scene.
        runs: one for each seed.
    """

    scene: str
    label: str
    method: str
    identity: Identity
    runs: tuple[Run, ...]

    @property
    def views(self) -> int | None:
        """Dynamic training views; None where unknown, or not the same for all runs."""
        counts = {run.number("run.train_views") for run in self.runs}
        count = counts.pop() if len(counts) == 1 else None
        return None if count is None else int(count)


def rows_of(runs: Sequence[Run]) -> list[RowOfRuns]:
    """Put runs into rows, in the order of a table: scenes as they come, ablations as the paper's.

    Args:
        runs: of any number of scenes.
    """
    traits = [_traits(run) for run in runs]
    keys = _telling(runs, traits)
    groups: dict[tuple[str, Identity], list[Run]] = defaultdict(list)
    for run, found in zip(runs, traits, strict=True):
        groups[run.scene, tuple(found.get(key) for key in keys)].append(run)
    rows: list[RowOfRuns] = []
    for (scene, identity), group in groups.items():
        told = dict(zip(keys, identity, strict=True))
        if _differ_in_seed(group):
            rows.append(_row(scene, told, group))
        else:
            rows += [_row(scene, {**told, "folder": run.name}, [run]) for run in group]
    scenes = list(dict.fromkeys(run.scene for run in runs))
    return sorted(rows, key=lambda row: (scenes.index(row.scene), *_order(row)))


def _traits(run: Run) -> Traits:
    """What is known of how a run was made, as ``key: text``."""
    found = dict[str, str | None]()
    if run.setup.choices is None:
        # Nothing says what it is, so nothing else may be taken for the same.
        found["folder"] = run.name
    for group, option in (run.setup.choices or {}).items():
        if group.split("/")[0] not in WATCHING:
            found[group] = option
    for override in run.setup.overrides:
        key, _, value = override.lstrip("+~").partition("=")
        watching = key.replace("/", ".").split(".")[0] in WATCHING
        if key not in found and key not in NOT_OF_A_ROW and not watching:
            found[f"={key}"] = value
    views, images = run.number("run.train_views"), run.number("run.test_frames")
    found["views"] = None if views is None else f"{views:g}"
    found["images"] = None if images is None else f"{images:g}"
    found["device"], found["revision"] = run.text("run.device"), run.text("run.git")
    found["version"] = run.text("run.devrf")
    return {key: text for key, text in found.items() if text is not None}


def _telling(runs: Sequence[Run], traits: Sequence[Traits]) -> list[str]:
    """The fewest traits, most telling first, that part whatever can be parted within a scene."""
    known = {key for found in traits for key in found}
    others = sorted(known - {*ALWAYS, *FIRST, *LAST})
    chosen = list(ALWAYS)
    parts: list[tuple[object, ...]] = [
        (run.scene, *map(found.get, ALWAYS)) for run, found in zip(runs, traits, strict=True)
    ]
    for key in (*FIRST, *others, *LAST):
        finer = [(*part, found.get(key)) for part, found in zip(parts, traits, strict=True)]
        if len(set(finer)) > len(set(parts)):
            chosen, parts = [*chosen, key], finer
    return chosen


def _label(told: Mapping[str, str | None]) -> str:
    ablation = told["ablation"]
    parts = ["Ours" if ablation is None else ABLATIONS.get(ablation, f"Ours ({ablation})")]
    parts += [_in_words(key, text) for key, text in told.items() if text and key != "ablation"]
    return "; ".join(parts)


def _in_words(key: str, text: str) -> str:
    match key:
        case "folder":
            return text
        case "views":
            return "1 view" if text == "1" else f"{text} views"
        case "images":
            return f"{text} held-out images"
        case "device":
            return f"on {text}"
        case "revision":
            return f"at {text[:9]}{'-dirty' * text.endswith('-dirty')}"
        case "version":
            return f"devrf {text}"
    return f"{key.lstrip('=')}={text}"


def _differ_in_seed(runs: Sequence[Run]) -> bool:
    seeds = {run.setup.seed for run in runs}
    return len(runs) == 1 or (None not in seeds and len(seeds) == len(runs))


def _row(scene: str, told: Mapping[str, str | None], runs: Sequence[Run]) -> RowOfRuns:
    method = _label({**told, "views": None})
    return RowOfRuns(scene, _label(told), method, tuple(told.values()), tuple(runs))


def _order(row: RowOfRuns) -> tuple[int, int, str]:
    names = list(ABLATIONS)
    ablation = row.identity[0]
    rank = names.index(ablation) if ablation in names else len(names)
    return rank, row.views or 0, row.label
