"""What was typed, completed: the command line that Hydra composes.

* Paths get the quotes that Hydra's grammar needs, and ``~`` is filled in.
* A run that is named (``ckpt=``, ``hydra.run.dir=``, ``hydra.sweep.dir=``) brings the overrides
  that it was learned with. What is typed comes after them: only that differs.
* ``experiment=NAME`` is taken in its form for the scene: ``best_small_forward``, ``paper_lego``.
* Where nothing chooses a schedule, ``facing=forward`` says what the scene's files do.
* A key of a level is added where the schedule's files do not name it.
* A scene's folder without a reader gets ``data=auto``: the reader that fits its files.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from itertools import product
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from devrf.cli.config import (
    APART,
    by_facing,
    config_folder,
    defaults_of,
    group_choices,
    overrides,
    reader_of,
)
from devrf.cli.messages import in_quotes
from devrf.cli.restore_config import of_named_run, parsed, value, values
from devrf.errors import DevrfError

# Keys whose values are files or folders.
PATHS = {
    *("data.root", "data.export", "data.flow_cache", "ckpt", "fetch.into", "export.into"),
    *("capture.static", "capture.into", "video.path"),
    *("report.runs", "report.into", "evaluation.lpips_weights"),
    *("hydra.run.dir", "hydra.sweep.dir"),
}
# `viewer` is a group, whose choices Hydra wants to be text.
SHORTHAND = {f"viewer={value}": f"viewer.training={value}" for value in ("true", "false")}
KEY_VALUE = re.compile(r"(\+{0,2}([\w./@-]+)=)(.*)", re.DOTALL)

# What beside an experiment says how a scene is learned.
OF_A_FORM = {"method", "comparison", "facing", "field", "schedule"}
# Readers of the embedded scenes, and what an experiment's form for them is called after.
EMBEDDED = {"procedural": ["embedded", "inward"], "procedural_forward": ["forward"]}
LEVELS = "schedule.deformation.levels."
# What conf/data/auto.yaml names, and keys that are not passed on with its options.
AUTOMATIC = "devrf.data.recorded.recognised_datamodule"
NOT_PASSED = ("_target_", "reader", "flow_cache")


def completed(arguments: Sequence[str]) -> list[str]:
    """The command line that Hydra composes for what was typed, without the program's name.

    Raises:
        DevrfError: a scene's folder cannot be recognised, an experiment has no one form for all
            scenes of a sweep, or a group's choice is null.
    """
    multirun = not {"-m", "--multirun"}.isdisjoint(arguments)
    words = [quoted_path(SHORTHAND.get(word.lower(), word), multirun) for word in arguments]
    at = [k for k, w in enumerate(words) if w[:1] != "-" and ("=" in w or w[:1] == "~")]
    texts = [words[k] for k in at]
    try:
        typed = parsed(texts)
    except HydraException:  # reported when Hydra parses them
        return words
    if not typed:
        return words
    for override in typed:
        group, is_null = override.key_or_group, override.value() is None
        if is_null and not override.is_delete() and (options := group_choices().get(group)):
            raise DevrfError(
                f"{override.input_line}: choose one of {', '.join(options)}, or leave it out"
            )
    before = of_named_run(typed, multirun)
    # A level that only the chosen schedule has need not name every key.
    texts = [f"++{text}" if text.startswith(LEVELS) else text for text in _in_form(texts, before)]
    both = parsed([*before, *texts])
    experiments = values(both, "experiment")
    if values(both, "data.root") and not any(override.key_or_group == "data" for override in both):
        readers = {reader_of(_chosen_by(name, "data") or "procedural") for name in experiments}
        if readers <= {*EMBEDDED}:
            before.append("data=auto")
        elif len(experiments) > 1:
            # Hydra composes a sweep once without what is swept: these keys are unknown there.
            texts = [f"++{text}" if text.startswith("data.") else text for text in texts]
    # Hydra takes all overrides from one place.
    after = [words[k] for k in range(at[0], len(words)) if k not in at]
    return [*words[: at[0]], *before, *texts, *after]


def quoted_path(argument: str, multirun: bool) -> str:
    """An argument as typed; if it names a file, as Hydra's grammar takes just that name.

    In a multirun a comma separates paths, as it does other values.
    """
    parts = KEY_VALUE.fullmatch(argument)
    if not parts or parts[2] not in PATHS or "${" in parts[3]:
        return argument
    try:
        (override,) = parsed([argument])
    except HydraException:
        paths = parts[3].split(",") if multirun else [parts[3]]
        return parts[1] + ",".join(in_quotes(os.path.expanduser(path)) for path in paths)
    read = override.value()
    if override.is_sweep_override() or read in (None, ""):
        return argument
    # A folder's name may look like a number or a list.
    path = os.path.expanduser(read if isinstance(read, str) else parts[3])
    return argument if read == path else parts[1] + in_quotes(path)


def _in_form(texts: list[str], before: Sequence[str]) -> list[str]:
    """The typed overrides, with ``experiment=NAME`` in its form for the scene.

    Of ``paper`` with ``data=lego`` that is ``paper_lego``, else ``paper_inward``, else ``paper``;
    of ``best_small`` with an embedded scene ``best_small_embedded``. Of a sweep over scenes with
    settings of their own, ``experiment=paper data=lego,plant``, it is one over such experiments,
    which name their data. Without an experiment a forward-facing scene from disk has
    ``best_small_forward``, in a comparison the settings of ``facing=forward``; other methods learn
    D-NeRF's kind of scene by ``protocol=dynamic``. What a named run was learned with has its form
    already, and its scene may be gone.

    Raises:
        DevrfError: a sweep's scenes need different forms.
    """
    both = parsed([*before, *texts])
    names, known = values(parsed(texts), "experiment"), set(group_choices()["experiment"])
    chosen = {o.key_or_group for o in both if (o.key_or_group, o.value()) != ("facing", "auto")}
    roots, stage = values(both, "data.root"), value(both, "stage")
    fresh = bool(roots) and not before and stage not in APART
    default = fresh and not names and not chosen & OF_A_FORM
    peer = fresh and value(both, "method") not in (None, "devrf")
    formed = any(other.startswith(f"{name}_") for name in names for other in known)
    readable = set(names) <= known and not any("${" in root for root in roots)
    by_scene = fresh and readable and not formed and "facing" not in chosen
    facing_counts = by_scene and _learns_by_default(both, names)
    if not (default or peer or formed or facing_counts):
        return texts
    from devrf.data.kind import ONE_CAMERA, kind_of  # loads torch

    options, space = values(both, "data") or ["auto"], value(both, "data.space")
    scenes = [
        [option, *(EMBEDDED.get(reader_of(option)) or kind_of(reader_of(option), root, space))]
        for option, root in product(options, roots or ([] if "auto" in options else [""]))
    ]
    if peer and not chosen & {"protocol", "comparison"} and all(ONE_CAMERA in k for k in scenes):
        texts = [*texts, "protocol=dynamic"]
    faced = {kinds[-1] for kinds in scenes}
    # Whether files tell what the options of `data` do not.
    differs = any(by_facing("auto", option) != kinds[-1] for option, *kinds in scenes)
    untold = facing_counts and differs
    if untold and len(faced) > 1:
        raise DevrfError(
            "data.root: DeVRF has other settings for forward-facing scenes than for inward-facing "
            "ones; sweep over the scenes of each apart"
        )
    if default:
        return [*texts, "experiment=best_small_forward"] if faced == {"forward"} else texts
    if untold:
        texts = [*(text for text in texts if text != "facing=auto"), "facing=forward"]
    if not names:
        return texts
    # The most specific form; the name itself where it has none.
    forms = [
        [next((f"{n}_{kind}" for kind in kinds if f"{n}_{kind}" in known), n) for n in names]
        for kinds in scenes or [["inward"]]
    ]
    if len(scenes) > 1 and forms == [[f"{names[0]}_{kinds[0]}"] for kinds in scenes]:
        forms = [[form for row in forms for form in row]]
        texts = [text for text in texts if not text.startswith("data=")]
    if any(form != forms[0] for form in forms):
        needed = dict.fromkeys(form for row in forms for form in row)
        raise DevrfError(
            f"experiment={','.join(names)}: these scenes need different forms of it; sweep over "
            f"the scenes of each apart, with experiment={' and experiment='.join(needed)}"
        )
    form = f"experiment={','.join(forms[0])}"
    return [form if text.startswith("experiment=") else text for text in texts]


def _learns_by_default(both: Sequence[Override], experiments: Sequence[str]) -> bool:
    """Whether DeVRF learns, and no experiment says how: its settings are those of the facing."""
    methods = values(both, "comparison") or values(both, "method") or ["devrf"]
    ours = any(method.startswith("devrf") for method in methods)
    return ours and not any(_chosen_by(name, "schedule") for name in experiments)


def _chosen_by(experiment: str, group: str) -> str | None:
    """The option of a group that an experiment chooses, if it does."""
    defaults = defaults_of("experiment", experiment)
    for entry in defaults:
        if not isinstance(entry, str) and f"override /{group}" in entry:
            return str(entry[f"override /{group}"])
    below = (_chosen_by(entry, group) for entry in defaults if isinstance(entry, str))
    return next((option for option in below if option), None)


def with_recognised_data(config: DictConfig) -> DictConfig:
    """The config with the reader that fits the scene's files in place of ``data=auto``.

    Options that are null have the reader's own defaults.

    Raises:
        DevrfError: the layout is unknown, or its reader has no such option.
    """
    data = config.data
    unread = config.stage == "report" or OmegaConf.is_missing(data, "root")
    if unread or data.get("_target_") != AUTOMATIC:
        return config
    # Imported here: --help and a misspelt key are answered before numpy and torch have loaded.
    from devrf.scenes.formats import recognise

    layout = recognise(data.root)
    chosen_data = OmegaConf.load(config_folder() / "data" / f"{layout.choice}.yaml")
    assert isinstance(chosen_data, DictConfig)
    raw: Any = OmegaConf.to_container(data)
    user_options = {k: v for k, v in raw.items() if v is not None and k not in NOT_PASSED}
    # As a list: a DictConfig does not "contain" what is required and not given.
    known = [str(name) for name in chosen_data if name not in NOT_PASSED]
    for key in user_options:
        if key not in known:
            raise DevrfError(
                f"data.{key}: {data.root} is read by data={layout.choice}, which takes "
                f"{', '.join(known)}"
            )
    with open_dict(config):
        config.data = OmegaConf.merge(chosen_data, user_options, {"flow_cache": raw["flow_cache"]})
    if HydraConfig.initialized():
        hydra: Any = HydraConfig.get()
        typed = [text for text in overrides() if not re.match(r"data(=auto|\.\w+=null)$", text)]
        with open_dict(hydra), read_write(hydra):
            # As if it had been typed: reports compare choices, later commands need no folder.
            hydra.runtime.choices.data = layout.choice
            hydra.overrides.task = [*typed, f"data={layout.choice}"]
    return config
