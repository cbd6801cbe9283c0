"""Rows of a table: the runs that share one, and its label.

Runs of one scene share a row if they were learned with the same settings but the seed, on the same
device by the same version, whatever was typed. A label says how its row differs from others of the
scene: in data, device and typed settings always; in the rest as little as tells the rows apart.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
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
    "tineuvox": "TiNeuVox",
    "kplanes": "K-Planes",
}
# As the paper's tables call them, in their order; then the rows of experiment=quality_table, for
# inward- and for forward-facing scenes.
ABLATIONS = {
    "cpu_small": "Ours, small",
    "quick_forward": "Ours, quick",
    "base": "Ours (base)",
    "c2f": "Ours w/ c2f",
    "c2f_tv": "Ours w/ c2f, tv",
    "c2f_tv_cycle": "Ours w/ c2f, tv, cycle",
    "full": "Ours w/ c2f, tv, cycle, flow",
    "without_elastic": "Ours w/o elastic prior",
    "without_bending": "Ours w/o bending prior",
    "without_masks": "Ours w/o masks' loss",
    "without_shading": "Ours w/o shading",
    "without_finishing": "Ours w/o finishing level",
    "without_frame_start": "Ours w/o starts from the best",
    "without_crop": "Ours w/o crop",
    "without_last_level": "Ours w/o last level",
}
CHOICES = "run.choices."
SETTINGS = "run.settings."
IGNORED = {"objective", "seed", "stage", "method"}
# A run without an experiment has the config of this one.
DEFAULT_EXPERIMENT = "quickstart"
# Groups whose options are names for many settings, most important first.
NAMED = ("experiment", "profile", "schedule", "field", "sampling", "loss", "method")
# Records of every run, and their form in a label.
RECORDED: dict[str, Callable[[Any], str]] = {
    "protocol": str,
    "run.train_views": lambda n: f"{n} view{'s' * (n != 1)}",
    "run.frames": lambda n: f"{n} frames",
    "run.image_size": lambda size: f"{size[0]}×{size[1]}",
    "run.device": lambda name: f"on {name}",
    "run.test_frames": lambda n: f"{n} held-out images",
    "run.lpips_network": lambda name: f"LPIPS of {name}",
    "run.fingerprint": lambda hashed: f"capture {hashed[:6]}",
    "run.git": lambda git: f"at {git[:9]}{'-dirty' * git.endswith('-dirty')}",
    "run.devrf": lambda version: f"devrf {version}",
}
# A label says every difference in these, before names and settings; the others come last.
SAID = list(RECORDED)[:5]
# Settings that a label does not repeat: the recorded numbers show them.
IN_DATA = ["data.width", "data.height", "data.downscale", "data.frames", "data.train_views"]


def labelled(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs in the order of a table: scenes as they come, ablations as in the paper, then jobs.

    Runs of a scene at rest count as runs of another scene than that in motion. So do runs that were
    learned in a limited time (``budget`` in seconds, NaN without a limit), or without priors.
    ``place`` is the scene with its priors, without its budget. Further columns are ``label``, the
    same for runs that share a row; ``name``, the label without the protocol; ``line``, the label
    without the number of views; ``views``, the number of dynamic training views (NaN where
    unknown); ``kind``, the same for runs of alike scenes with the same names and typed settings.
    """
    names = _names(runs)
    settings = _settings(runs)
    settings.pop("schedule.seconds", None)  # said by the scene's title
    typed = _typed(settings, runs)
    scenes = runs["scene"].where(~runs["at_rest"].eq(True), runs["scene"] + " (at rest)")
    unknown = pd.Series(None, runs.index, dtype=object)
    bare = runs.get(f"{SETTINGS}priors", unknown).eq("none")
    budget = runs.get(f"{SETTINGS}schedule.seconds", unknown).map(number).astype(float)
    places = scenes.mask(bare, scenes + ", without priors")
    scenes = places.where(budget.isna(), places + budget.map(", {:g} s".format))
    # A row has one name, whatever its budget.
    traits = _distinguishing(runs.assign(scene=places), names, settings, typed)
    runs = runs.assign(scene=scenes, place=places, budget=budget)
    alike = ["at_rest", "run.kind", "run.image_size", "budget", f"{SETTINGS}priors"]
    same = runs.reindex(columns=[*alike, "run.train_views"])
    views = same.pop("run.train_views").map(number).astype(float)
    same = same.assign(**names, **{k: settings[k] for k in typed if not k.startswith("data.")})
    ordered = runs.assign(
        label=_label(traits),
        name=_label(traits, without="protocol"),
        line=_label(traits, without="run.train_views"),
        views=views,
        kind=list(map(str, same.itertuples(index=False, name=None))),
        by_scene=pd.factorize(scenes)[0],
        by_method=[_rank(method, METHODS) for method in runs["method"]],
        by_name=[_rank(name, ABLATIONS.values()) for name in traits["method"]],
    )
    order = ["by_scene", "by_method", "by_name", "views"]
    return ordered.sort_values(order, kind="stable").drop(columns=order[:3])


def _rank(name: str, names: Iterable[str]) -> int:
    """The place of a name among those that have one; others come last."""
    return [*names, name].index(name)


def _label(traits: pd.DataFrame, without: str = "") -> list[str]:
    columns = traits.drop(columns=without, errors="ignore")
    return ["; ".join(filter(None, texts)) for texts in columns.itertuples(index=False)]


def _distinguishing(
    runs: pd.DataFrame,
    names: Mapping[str, pd.Series],
    settings: Mapping[str, pd.Series],
    typed: Sequence[str],
) -> pd.DataFrame:
    """Traits of the runs in labels: a column for each, empty where it distinguishes no rows."""
    recorded = {
        key: runs[key].map(text, na_action="ignore").fillna("")
        for key, text in RECORDED.items()
        if key in runs
    }
    traits = pd.DataFrame({"method": _methods(runs), **recorded, **names, **settings})
    # All traits that distinguish a run from unequal ones, whatever its names.
    identity = pd.DataFrame({"method": runs["method"], **recorded, **settings})
    equal = traits.groupby([runs["scene"], pd.Series(_label(identity), runs.index)])
    # Equal runs have one name, that of the ablation that its settings were called by, if any.
    traits["method"] = equal["method"].transform(
        lambda names: min(names, key=lambda name: _rank(name, ABLATIONS.values()))
    )
    said = [key for key in recorded if key in SAID]
    distinct = ["method"]
    for key in dict.fromkeys([*said, *names, *typed, *settings, *recorded]):
        values = traits[key].mask(traits[key] == "").groupby(runs["scene"])
        differs = key in (*said, *typed) and values.nunique().gt(1).any()
        # A name is left out only if other names imply it.
        beside = [trait for trait in distinct if key not in names or trait in ("method", *names)]
        rows = [runs["scene"], *(traits[trait] for trait in beside)]
        tells = traits.groupby([*rows, traits[key]]).ngroups > traits.groupby(rows).ngroups
        # Names that equal runs do not share, such as an experiment's that was typed out, are none.
        if (differs or tells) and equal[key].nunique().eq(1).all():
            distinct.append(key)
    several = traits.groupby(runs["scene"])[distinct].transform("nunique") > 1
    return traits[distinct].where(several.assign(method=True), "")


def _methods(runs: pd.DataFrame) -> list[str]:
    """Names of methods and ablations; runs of a scene at rest have no ablation."""
    names = []
    ablations = _options(runs, "ablation")
    for method, ablation, at_rest in zip(runs["method"], ablations, runs["at_rest"], strict=True):
        name = METHODS.get(method, method)
        if at_rest is not True and method == DEFAULT_METHOD and ablation in ABLATIONS:
            name = ABLATIONS[ablation]
        elif at_rest is not True and ablation not in ("", "full"):
            name = f"{name} ({ablation})"
        names.append(name)
    return names


def _options(runs: pd.DataFrame, group: str) -> pd.Series:
    options = runs.get(CHOICES + group, pd.Series(None, runs.index, dtype=object))
    return options.map(lambda option: option if isinstance(option, str) else "")


def _names(runs: pd.DataFrame) -> dict[str, pd.Series]:
    """The options of config groups; empty where there is none, or it is the method's name."""
    names = {}
    for group in NAMED:
        options = _options(runs, group)
        if group == "profile":  # dnerf_small: a size of that method
            both = zip(options, runs["method"], strict=True)
            options = pd.Series([o.removeprefix(f"{m}_") for o, m in both], runs.index)
        if group == "experiment":
            usual = options.eq("") & runs["method"].eq(DEFAULT_METHOD)
            options = options.mask(usual, DEFAULT_EXPERIMENT)
        said = options.eq("") | options.eq(runs["method"])
        names[CHOICES + group] = (f"{group}=" + options).mask(said, "")
    return names


def _settings(runs: pd.DataFrame) -> dict[str, pd.Series]:
    """The settings that runs were learned with, by key; the text is empty for runs without one.

    Numbers have as few digits, three at least, as keep them apart.
    """
    settings = {}
    for column in runs:
        key = column.removeprefix(SETTINGS)
        if key == column or key in IGNORED:
            continue
        values = runs[column]
        numbers = values.map(number).dropna()
        for digits in range(3, 18):
            short = numbers.map(lambda x, n=digits: f"{x:.{max(n, len(f'{x:.0f}'))}g}")
            if short.nunique() == numbers.nunique():
                break
        texts = values.map(lambda value: value if isinstance(value, str) else json.dumps(value))
        texts.update(short)
        # null is None; NaN says that there is no such key.
        settings[key] = (f"{key}=" + texts).mask(values.map(lambda value: value != value), "")
    return settings


def _typed(settings: Iterable[str], runs: pd.DataFrame) -> list[str]:
    """The settings of which a run's user typed the value, or that of the mapping they lie in."""
    keys = {text.partition("=")[0].lstrip("+") for texts in runs["run.overrides"] for text in texts}
    typed = tuple(f"{key}." for key in keys if CHOICES + key not in runs)
    return [key for key in settings if f"{key}.".startswith(typed) and key not in IN_DATA]
