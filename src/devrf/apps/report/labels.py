"""Rows of a table: what they are called, and the runs that share one.

A row is named by what its runs were asked to learn: method and ablation, protocol, experiment, and
what was typed. Its runs were learned with equal settings but the seed, on equal data, on one
device, by one version: there may be several rows of one name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from devrf.apps.report.runs import (
    DEFAULT_METHOD,
    DEFAULT_PROTOCOL,
    LONGEST_NAME,
    PRIORS,
    SECONDS,
    number,
)
from devrf.system.printed import shown

METHODS = {
    DEFAULT_METHOD: "Ours",
    "dnerf": "D-NeRF",
    "nerfies": "Nerfies",
    "hypernerf": "HyperNeRF",
    "nsff": "NSFF",
    "neural_volumes": "Neural Volumes",
    "tineuvox": "TiNeuVox",
    "kplanes": "K-Planes",
    "gaussians": "Gaussians",
}
# As the paper's tables call them.
ABLATIONS = {
    "base": "Ours (base)",
    "c2f": "Ours w/ c2f",
    "c2f_tv": "Ours w/ c2f, tv",
    "c2f_tv_cycle": "Ours w/ c2f, tv, cycle",
    "full": "Ours w/ c2f, tv, cycle, flow",
}
CHOICES = "run.choices."
SETTINGS = "run.settings."
# Of those that decide what is learned, where they are not the usual ones.
CALLBACKS = f"{SETTINGS}callbacks."
# A run without an experiment has the config of this one.
DEFAULT_EXPERIMENT = "quickstart"
# Groups of settings that may be typed beside those that have a part of the name of their own.
GROUPS = ("method", "profile", "schedule", "field", "sampling", "loss")
# Settings that say which scene it is, and those that its title says.
OF_TITLE = {"data.root", "data.name", "data.shape", "data.scene_seed", "priors", "schedule.seconds"}
NOT_LEARNED = {"objective", "seed", "stage", "method"}
# What runs that share a row have in common beside their settings.
RECORDED = (
    *("method", "run.train_views", "run.frames", "run.image_size", "run.test_frames"),
    *("run.device", "run.lpips_network", "run.motion_masks", "run.benchmark"),
    *("run.fingerprint", "run.git", "run.devrf"),
)


def labelled(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs in the order of a table: scenes as they come, then methods, then jobs.

    Runs of a scene at rest count as runs of another scene than that in motion. So do runs that were
    learned in a limited time (``budget`` in seconds, NaN without a limit), or without priors.
    ``place`` is the scene with its priors, without its budget. Further columns are ``label``, the
    row's name; ``views``, the number of dynamic training views (NaN where unknown); ``identity``,
    the same for runs that share a row; ``kind``, the same for runs of alike scenes.
    """
    budget = runs[SECONDS].map(number).astype(float)
    place = runs["scene"] + np.where(runs["at_rest"].eq(True), " (at rest)", "")
    place += np.where(runs[PRIORS].eq("none"), ", without priors", "")
    scene = place.where(budget.isna(), place + budget.map(", {:g} s".format))
    records = runs.to_dict("records")
    methods = [*METHODS, *runs["method"].unique()]
    runs = runs.assign(
        scene=scene,
        place=place,
        budget=budget,
        label=[row_name(run) for run in records],
        views=runs["run.train_views"].map(number).astype(float),
        identity=_as_text(runs, identity_columns(runs)),
        kind=_as_text(runs, ["at_rest", "run.kind", "run.image_size", "run.benchmark", PRIORS]),
        by_scene=pd.factorize(scene)[0],
        by_method=runs["method"].map(methods.index),
    )
    return runs.sort_values(["by_scene", "by_method"], kind="stable")


def row_name(run: Mapping[str, Any]) -> str:
    """A run's name by method and ablation, protocol, experiment and typed settings."""
    method = run["method"]
    ablation = _option(run, "ablation") or "full"
    parts = [METHODS.get(method, method)]
    if run["at_rest"] is not True:  # there are no ablations of a scene at rest
        if method == DEFAULT_METHOD and ablation in ABLATIONS:
            parts = [ABLATIONS[ablation]]
        elif ablation != "full":
            parts = [f"{parts[0]} ({ablation})"]
    # Another program did not follow devrf's protocol, and has no settings but those of the data.
    foreign = isinstance(run.get("run.predictions"), str)
    unsaid = method == DEFAULT_METHOD or foreign
    usual = (DEFAULT_PROTOCOL, DEFAULT_EXPERIMENT) if unsaid else ()
    parts += [p for p in (run["protocol"], _option(run, "experiment")) if p not in usual]
    for text in run["run.overrides"]:
        key, _, value = text.lstrip("+").partition("=")
        setting = run.get(SETTINGS + key, float("nan"))
        is_setting = setting == setting and key not in NOT_LEARNED  # null is None, absent is NaN
        is_setting |= foreign and key.startswith("data.")
        if key not in OF_TITLE and (is_setting or key in GROUPS and value != method):
            parts.append(f"{key}={value}")
    # Typed as code, which no checkpoint keeps among what was typed.
    callbacks = {key: value for key, value in run.items() if key.startswith(CALLBACKS)}
    for key, value in callbacks.items():
        if value == value:
            said = "null" if value is None else value
            parts.append(f"{key.removeprefix(SETTINGS)}={said}")
    name = shown("; ".join(filter(None, parts)))
    return name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]}..."


def identity_columns(runs: pd.DataFrame) -> list[str]:
    """Columns in which runs that share a row agree."""
    settings = [column for column in runs if column.startswith(SETTINGS)]
    return [*RECORDED, *(c for c in settings if c.removeprefix(SETTINGS) not in NOT_LEARNED)]


def _as_text(runs: pd.DataFrame, columns: list[str]) -> list[str]:
    return [str(row) for row in runs.reindex(columns=columns).itertuples(index=False, name=None)]


def _option(run: Mapping[str, Any], group: str) -> str:
    """The option of a config group; empty where there is none."""
    option = run.get(CHOICES + group)
    return option if isinstance(option, str) else ""
