"""Which runs share a row of a table, and what the row is called.

Runs of one scene share a row unless they differ in something other than the seed and the folder.
What tells rows apart becomes part of their label, and nothing else does.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
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
ALWAYS = ("method", "folder")
FIRST = ("protocol", "views", "experiment", "schedule", "field", "sampling", "loss")
LAST = ("images", "device", "revision", "version")


def labelled(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs in the order of a table: scenes as they come, ablations as in the paper.

    Returns:
        The runs with further columns: ``label``, the same for runs that share a row; ``name``, the
        label without the protocol; ``line``, the label without the number of views; ``views``,
        the number of dynamic training views (NaN where unknown).
    """
    told = _telling(runs["scene"], [_traits(run) for run in runs.to_dict("records")])
    views = runs.get("run.train_views", pd.Series(None, runs.index, dtype=object))
    found = runs.assign(
        label=[_label(traits) for traits in told],
        name=[_label(traits, without="protocol") for traits in told],
        line=[_label(traits, without="views") for traits in told],
        views=views.map(number).astype(float),
        by_scene=pd.factorize(runs["scene"])[0],
        by_method=[_rank(method, METHODS) for method in runs["method"]],
        by_name=[_rank(traits["method"], ABLATIONS.values()) for traits in told],
    )
    order = ["by_scene", "by_method", "by_name", "views", "label"]
    return found.sort_values(order, kind="stable").drop(columns=order[:3])


def _rank(name: str, names: Iterable[str]) -> int:
    """The place of a name among those that have one; others come last."""
    return [*names, name].index(name)


def _traits(run: Mapping[str, Any]) -> dict[str, str]:
    """What is known of how a run was made, each in the words of a label."""
    options = {
        key.removeprefix(CHOICES): option if isinstance(option, str) else ""
        for key, option in run.items()
        if key.startswith(CHOICES)
    }
    ablation = options.get("ablation", "")
    found = {"method": _method(run["method"], ablation), "protocol": run["protocol"]}
    for group, option in options.items():
        if option and group != "ablation" and option != run.get(group):
            found[f"={group}" if group in found else group] = f"{group}={option}"
    if not any(options.values()):  # no other run may be taken for the same
        found["folder"] = run["folder"]
    views, images = run.get("run.train_views"), run.get("run.test_frames")
    device, revision, version = (run.get(f"run.{key}") for key in ("device", "git", "devrf"))
    if isinstance(views, int):
        found["views"] = f"{views} view{'s' * (views != 1)}"
    if isinstance(images, int):
        found["images"] = f"{images} held-out images"
    if isinstance(device, str):
        found["device"] = f"on {device}"
    if isinstance(revision, str):
        found["revision"] = f"at {revision[:9]}{'-dirty' * revision.endswith('-dirty')}"
    if isinstance(version, str):
        found["version"] = f"devrf {version}"
    for override in run["run.overrides"]:
        key, _, value = override.lstrip("+~").partition("=")
        if key not in options and key not in NOT_OF_A_ROW:
            found[f"={key}"] = f"{key}={value}"
    parts = {key: re.split("[./]", key.lstrip("="))[0] for key in found}
    return {key: text for key, text in found.items() if parts[key] not in WATCHING}


def _method(method: str, ablation: str) -> str:
    name = METHODS.get(method, method)
    if method == DEFAULT_METHOD and ablation in ABLATIONS:
        return ABLATIONS[ablation]
    return name if ablation in ("", "full") else f"{name} ({ablation})"


def _telling(scenes: pd.Series, traits: list[dict[str, str]]) -> list[dict[str, str]]:
    """Of each run the fewest traits, most telling first, that separate what differs in a scene."""
    frame = pd.DataFrame(traits, index=scenes.index, dtype=object).fillna("")
    others = sorted(set(frame) - {*ALWAYS, *FIRST, *LAST})
    keys = (*FIRST, *others, *LAST)
    frame = frame.reindex(columns=[*ALWAYS, *keys], fill_value="").assign(scene=scenes)
    chosen = list(ALWAYS)
    rows = frame.groupby(["scene", *chosen]).ngroups
    for key in keys:
        finer = frame.groupby(["scene", *chosen, key]).ngroups
        if finer > rows:
            chosen, rows = [*chosen, key], finer
    return list(frame[chosen].to_dict("records"))


def _label(told: Mapping[str, str], without: str = "") -> str:
    return "; ".join(text for key, text in told.items() if text and key != without)
