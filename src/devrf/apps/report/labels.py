"""Which runs share a row of a table, and the row's label.

Runs of one scene share a row if they were learned with the same settings but the seed, on the same
device by the same version, whatever was typed. A label says only what distinguishes its row from
the others of the scene.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import pandas as pd

from devrf.apps.report.runs import DEFAULT_METHOD, number

METHODS = {
    DEFAULT_METHOD: "Ours",
    "dnerf": "D-NeRF",
    "nerfies": "Nerfies",
    "hypernerf": "HyperNeRF",
    "nsff": "NSFF",
    "neural_volumes": "Neural Volumes",
}
# As the paper's tables call them, in their order; then what experiment=quality_table adds up.
ABLATIONS = {
    "base": "Ours (base)",
    "c2f": "Ours w/ c2f",
    "c2f_tv": "Ours w/ c2f, tv",
    "c2f_tv_cycle": "Ours w/ c2f, tv, cycle",
    "full": "Ours w/ c2f, tv, cycle, flow",
    "paper_terms": "Ours, the paper's terms",
    "along_flow": "+ start along flow",
    "changing_colors": "+ changing colours",
    "elastic": "+ elastic motion",
    "more_sweeps": "+ two more sweeps",
    "finishing": "+ a finishing level",
    "refinement": "+ refinement",
    "shading": "+ shading",
    "tracks": "+ start along tracks",
    "best": "+ finer field at rest",
}
# Config groups and keys that decide what is logged, not what is learned.
LOGGING = {"logger", "callbacks", "video", "report", "hydra"}
IGNORED = {"objective", "seed", "stage"}
CHOICES, SETTINGS = "run.choices.", "run.settings."
# Without an experiment a run has the config of this one.
DEFAULT_EXPERIMENT = "quickstart"
# Traits that distinguish rows, most important first; other groups and overrides come before LAST.
ALWAYS = ("method",)
FIRST = ("protocol", "views", "experiment", "schedule", "field", "sampling", "loss")
LAST = ("images", "capture", "device", "revision", "version")
# All that tells a run from unequal ones, whatever it is called; never part of a label.
IDENTITY = "identity"
# Traits that every run records: the key, its type, and how it stands in a label.
RECORDED: tuple[tuple[str, str, type, Callable[[Any], str]], ...] = (
    ("views", "train_views", int, lambda n: f"{n} view{'s' * (n != 1)}"),
    ("images", "test_frames", int, lambda n: f"{n} held-out images"),
    ("capture", "fingerprint", str, lambda hashed: f"capture {hashed[:6]}"),
    ("device", "device", str, lambda name: f"on {name}"),
    ("revision", "git", str, lambda git: f"at {git[:9]}{'-dirty' * git.endswith('-dirty')}"),
    ("version", "devrf", str, lambda version: f"devrf {version}"),
)


def labelled(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs in the order of a table: scenes as they come, ablations as in the paper.

    Further columns are ``label``, the same for runs that share a row; ``name``, the label without
    the protocol; ``line``, the label without the number of views; ``views``, the number of dynamic
    training views (NaN where unknown).
    """
    traits = _distinguishing(runs["scene"], [_traits(run) for run in runs.to_dict("records")])
    views = runs.get("run.train_views", pd.Series(None, runs.index, dtype=object))
    ordered = runs.assign(
        label=[_label(trait) for trait in traits],
        name=[_label(trait, without="protocol") for trait in traits],
        line=[_label(trait, without="views") for trait in traits],
        views=views.map(number).astype(float),
        by_scene=pd.factorize(runs["scene"])[0],
        by_method=[_rank(method, METHODS) for method in runs["method"]],
        by_name=[_rank(trait["method"], ABLATIONS.values()) for trait in traits],
    )
    order = ["by_scene", "by_method", "by_name", "views", "label"]
    return ordered.sort_values(order, kind="stable").drop(columns=order[:3])


def _rank(name: str, names: Iterable[str]) -> int:
    """The place of a name among those that have one; others come last."""
    return [*names, name].index(name)


def _traits(run: Mapping[str, Any]) -> dict[str, str]:
    """A run's configuration, data, device and version, each as it stands in a label."""
    options = {
        key.removeprefix(CHOICES): option if isinstance(option, str) else ""
        for key, option in run.items()
        if key.startswith(CHOICES)
    }
    ablation = options.get("ablation", "")
    traits = {"method": _method(run["method"], ablation), "protocol": run["protocol"]}
    for trait, key, kind, words in RECORDED:
        value = run.get(f"run.{key}")
        if isinstance(value, kind):
            traits[trait] = words(value)
    traits |= _settings(run)
    distinct = {key: text for key, text in traits.items() if key != "method"}
    traits[IDENTITY] = json.dumps({**distinct, "method": run["method"]}, sort_keys=True)
    if run["method"] == DEFAULT_METHOD:
        options["experiment"] = options.get("experiment") or DEFAULT_EXPERIMENT
    for group, option in options.items():
        if option and group != "ablation" and option != run.get(group):
            traits[f"={group}" if group in traits else group] = f"{group}={option}"
    parts = {key: re.split("[./]", key.lstrip("="))[0] for key in traits}
    return {key: text for key, text in traits.items() if parts[key] not in LOGGING}


def _settings(run: Mapping[str, Any]) -> dict[str, str]:
    """The settings that a run was learned with, by key."""
    settings = {}
    for column, value in run.items():
        key = column.removeprefix(SETTINGS)
        # Of a key that the run does not have the value is NaN; null is None.
        absent = isinstance(value, float) and math.isnan(value)
        if key != column and key not in (*IGNORED, "method") and not absent:
            text = value if isinstance(value, str) else json.dumps(value)
            settings[f"={key}"] = f"{key}={text}"
    return settings


def _method(method: str, ablation: str) -> str:
    name = METHODS.get(method, method)
    if method == DEFAULT_METHOD and ablation in ABLATIONS:
        return ABLATIONS[ablation]
    return name if ablation in ("", "full") else f"{name} ({ablation})"


def _distinguishing(scenes: pd.Series, traits: list[dict[str, str]]) -> list[dict[str, str]]:
    """Of each run the traits, as few as possible, that separate the different runs of a scene."""
    frame = pd.DataFrame(traits, index=scenes.index, dtype=object).fillna("")
    others = sorted(set(frame) - {*ALWAYS, *FIRST, *LAST, IDENTITY})
    keys = (*FIRST, *others, *LAST)
    frame = frame.reindex(columns=[*ALWAYS, *keys, IDENTITY], fill_value="").assign(scene=scenes)
    equal = frame.groupby(["scene", IDENTITY])
    # Equal runs have one name, that of the ablation that its settings were called by, if any.
    frame["method"] = equal["method"].transform(
        lambda names: min(names, key=lambda name: _rank(name, ABLATIONS.values()))
    )
    chosen = list(ALWAYS)
    rows = frame.groupby(["scene", *chosen]).ngroups
    for key in keys:
        finer = frame.groupby(["scene", *chosen, key]).ngroups
        # What equal runs call differently, such as an experiment that was typed out, is no name.
        if finer > rows and (equal[key].nunique() == 1).all():
            chosen, rows = [*chosen, key], finer
    return list(frame[chosen].to_dict("records"))


def _label(traits: Mapping[str, str], without: str = "") -> str:
    return "; ".join(text for key, text in traits.items() if text and key != without)
