"""Which runs share a row of a table, and what the row is called.

Runs of one scene share a row unless they differ in something other than the seed and the folder.
What tells rows apart becomes part of their label, and nothing else does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

from devrf.reporting.runs import DEFAULT_METHOD, number

METHODS = {
    DEFAULT_METHOD: "Ours",
    "dnerf": "D-NeRF",
    "nerfies": "Nerfies",
    "hypernerf": "HyperNeRF",
    "nsff": "NSFF",
    "neural_volumes": "Neural Volumes",
}
# As the paper's tables call them, in their order.
ABLATIONS = {
    "base": "Ours (base)",
    "c2f": "Ours w/ c2f",
    "c2f_tv": "Ours w/ c2f, tv",
    "c2f_tv_cycle": "Ours w/ c2f, tv, cycle",
    "full": "Ours w/ c2f, tv, cycle, flow",
}

# Config groups and keys that decide how a run is watched, not what it learns.
WATCHING = {"logger", "callbacks", "video", "report", "hydra"}
NOT_OF_A_ROW = {"objective", "seed", "stage"}
CHOICES = "run.choices."

# What tells rows apart, most telling first; other groups and overrides come by name before LAST.
ALWAYS = ("method", "ablation", "folder")
FIRST = ("protocol", "views", "experiment", "schedule", "field", "sampling", "loss")
LAST = ("images", "device", "revision", "version")


def labelled(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs in the order of a table: scenes as they come, ablations as in the paper.

    Returns:
        The runs with further columns: ``label``, the same for runs that share a row; ``name``, the
        label without the protocol; ``line``, the label without the number of views; ``views``,
        the number of dynamic training views (NaN where unknown).
    """
    traits = [_traits(run) for run in runs.to_dict("records")]
    told = _telling(runs["scene"], traits)
    ranks = [list(METHODS), list(ABLATIONS)]
    found = runs.assign(
        label=[_label(one) for one in told],
        name=[_label(one, without="protocol") for one in told],
        line=[_label(one, without="views") for one in told],
        views=[number(one) for one in runs.get("run.train_views", [None] * len(runs))],
        scene_rank=pd.factorize(runs["scene"])[0],
        method_rank=[_rank(one["method"], ranks[0]) for one in told],
        ablation_rank=[_rank(one["ablation"], ranks[1]) for one in told],
    )
    order = ["scene_rank", "method_rank", "ablation_rank", "views", "label"]
    return found.sort_values(order, kind="stable").drop(columns=order[:3])


def _rank(name: str, names: list[str]) -> int:
    return names.index(name) if name in names else len(names)


def _traits(run: Mapping[str, Any]) -> dict[str, str | None]:
    """What is known of how a run was made, as ``key: text``."""
    groups = {
        key.removeprefix(CHOICES): option if isinstance(option, str) else None
        for key, option in run.items()
        if key.startswith(CHOICES)
    }
    found = {
        **{key: text for key, text in groups.items() if key.split("/")[0] not in WATCHING},
        "method": run["method"],
        "protocol": run["protocol"],
        "views": _count(run.get("run.train_views")),
        "images": _count(run.get("run.test_frames")),
        "device": _text(run.get("run.device")),
        "revision": _text(run.get("run.git")),
        "version": _text(run.get("run.devrf")),
        # Where the options were not recorded, no other run may be taken for the same.
        "folder": None if any(groups.values()) else run["folder"],
    }
    if run["method"] != DEFAULT_METHOD and groups.get("ablation") == "full":
        found["ablation"] = None
    overrides = run["run.overrides"]
    for override in overrides if isinstance(overrides, list) else ():
        key, _, value = override.lstrip("+~").partition("=")
        watching = key.replace("/", ".").split(".")[0] in WATCHING
        if key not in groups and key not in NOT_OF_A_ROW and not watching:
            found[f"={key}"] = value
    return found


def _telling(scenes: pd.Series, traits: list[dict[str, str | None]]) -> list[dict[str, str]]:
    """Of each run the fewest traits, most telling first, that separate what differs in a scene."""
    frame = pd.DataFrame(traits, index=scenes.index, dtype=object).fillna("")
    others = sorted(set(frame) - {*ALWAYS, *FIRST, *LAST})
    keys = (*FIRST, *others, *LAST)
    frame = frame.reindex(columns=[*ALWAYS, *keys], fill_value="").assign(scene=scenes)

    def rows(chosen: list[str]) -> int:
        return int(frame.groupby(["scene", *chosen]).ngroups)

    chosen = list(ALWAYS)
    for key in keys:
        if rows([*chosen, key]) > rows(chosen):
            chosen.append(key)
    return list(frame[chosen].to_dict("records"))


def _label(told: Mapping[str, str], without: str = "") -> str:
    method, ablation = told["method"], told["ablation"]
    label = METHODS.get(method, method)
    if ablation:
        named = method == DEFAULT_METHOD and ablation in ABLATIONS
        label = ABLATIONS[ablation] if named else f"{label} ({ablation})"
    further = {key: text for key, text in told.items() if key not in ("method", "ablation")}
    return "; ".join(
        [label, *(_in_words(key, text) for key, text in further.items() if text and key != without)]
    )


def _in_words(key: str, text: str) -> str:
    match key:
        case "folder" | "protocol":
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


def _count(value: Any) -> str | None:
    known = number(value)
    return f"{known:g}" if known == known else None


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None
