"""Completes the typed command line, for Hydra to compose.

* Paths get the quotes that Hydra's grammar needs, and ``~`` is filled in.
* A run that is named (``ckpt=``, ``hydra.run.dir=``, ``hydra.sweep.dir=``) brings the overrides
  that it was learned with. Typed overrides come after them: only these differ.
* A scene's folder brings settings that its files determine and nothing else sets: ``data=``,
  ``facing=``; if one camera filmed it, or ``data.camera=handheld``, ``protocol=dynamic`` for a
  method that is typed. Where none is, DeVRF cannot learn such a scene, and the run is refused.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path

from hydra import initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf.errors import OmegaConfBaseException

from devrf.cli.config import PATHS, SCENELESS_STAGES, STEPS, config_folder, group_choices
from devrf.cli.restore_config import (
    applied_defaults,
    of_named_run,
    parsed,
    searched_runs,
    value,
    values,
)
from devrf.cli.view import serves_page
from devrf.errors import DevrfError
from devrf.system.override import literal, without_reference
from devrf.system.process import importing

# Stages of DeVRF's protocol alone.
DEVRF_STAGES = ("canonical", "deformation")
# Training settings of a scene: groups, and keys that DeVRF alone has.
TRAINING_KEYS = (
    *("method", "profile", "protocol", "comparison", "experiment", "ablation", "hparams_search"),
    *("data.static_until", "field", "sampling", "loss", "canonical", "deformation"),
    *("schedule.canonical", "schedule.deformation", "schedule.motion"),
)
# `viewer` is a group, whose choices Hydra wants to be text; so it does of these.
SHORTHAND = {f"viewer={value}": f"viewer.training={value}" for value in ("true", "false")}
SHORTHAND |= {f"{group}=null": f"~{group}" for group in ("logger", "callbacks")}
KEY_VALUE = re.compile(r"(\+{0,2}([\w./@-]+)=)(.*)", re.DOTALL)


def commands(arguments: Sequence[str]) -> list[list[str]]:
    """The commands that typed arguments stand for: on the folder of a search, one for each run.

    Raises:
        DevrfError: no run of the search has learned anything.
    """
    named = [word for word in arguments if word.startswith("hydra.sweep.dir=")]
    runs: list[Path] = []
    if named:
        options, _ = get_args_parser().parse_known_intermixed_args(arguments)
        with suppress(HydraException):  # reported when Hydra parses them
            runs = searched_runs(parsed(quoted_path(word, False) for word in options.overrides))
    others = [word for word in arguments if word not in (*named, "-m", "--multirun")]
    return [[*others, f"hydra.run.dir={literal(str(run))}"] for run in runs] or [[*arguments]]


def completed(arguments: Sequence[str]) -> list[str]:
    """The command line for Hydra to compose, by typed arguments, without the program's name.

    Raises:
        DevrfError: a scene's folder cannot be recognised, the scenes of a sweep need different
            options, a scene is none for DeVRF, a group's choice is null, or a word is another
            framework's.
    """
    applied_defaults.clear()
    options, unknown = get_args_parser().parse_known_intermixed_args(arguments)
    for word in unknown:
        meant = word.lstrip("-") if "=" in word else "KEY=VALUE, without dashes"
        raise DevrfError(f"{word}: no such option; write {meant}, or --help for what there is")
    rerun = options.experimental_rerun
    if rerun is not None and not Path(rerun).is_file():
        raise DevrfError(f"--experimental-rerun: {rerun}: no such file; give a job's config.pickle")
    flags = [word for word in arguments if word not in options.overrides]
    texts = [SHORTHAND.get(word.lower(), word) for word in options.overrides]
    in_sweep = options.multirun or _sweeps(texts, options.config_dir)
    texts = [quoted_path(text, in_sweep) for text in texts]
    try:
        typed = parsed(texts)
    except HydraException:  # reported when Hydra parses them
        return [*flags, *texts]
    for override in typed:
        names = group_choices().get(override.key_or_group)
        one = not override.is_delete() and not override.is_sweep_override()
        if names and one and not isinstance(override.value(), str | list):
            line = override.input_line
            raise DevrfError(f"{line}: choose one of {', '.join(names)}, or leave it out")
        if override.key_or_group == "debug":
            raise DevrfError(
                f"{override.input_line}: no such group; rehearse=true takes every step in minutes, "
                "+trainer.fast_dev_run=true a step of each stage"
            )
    run = value(typed, "hydra.run.dir")
    if run is not None and serves_page(typed, Path(run)):
        return [*flags, *texts]
    before = of_named_run(typed, options.multirun)
    roots = values(typed, "data.root")
    overrides = parsed([*before, *texts])
    needs_scene = value(overrides, "stage") not in SCENELESS_STAGES
    if needs_scene and value(overrides, "data.camera") == "handheld":
        words = _for_one_camera("data.camera=handheld", overrides, continued=bool(before))
        if words:
            applied_defaults.append(f"data.camera=handheld: one camera ({' '.join(words)})")
        return [*flags, *before, *texts, *words]
    if not (roots and needs_scene) or any("${" in root for root in roots):
        return [*flags, *before, *texts]
    readers: list[str | None] = [*values(overrides, "data")]
    readers = readers or _of_experiments(overrides, options.config_dir)
    defaults = [
        _defaults_of_scene(reader, root, overrides, continued=bool(before))
        for reader, root in product(readers, roots)
    ]
    if any(words != defaults[0] for words in defaults):
        needed = " and ".join(dict.fromkeys(" ".join(words) or "neither" for words in defaults))
        raise DevrfError(f"data.root: the scenes need {needed}; sweep over those of each apart")
    return [*flags, *before, *texts, *defaults[0]]


def quoted_path(argument: str, multirun: bool) -> str:
    """An argument as typed; if it names a file, as Hydra's grammar takes just that name.

    In a multirun a comma separates paths, as it does other values; else it belongs to the name.

    Raises:
        DevrfError: it names a file that no config can hold.
    """
    match = KEY_VALUE.fullmatch(argument)
    if not match or match[2] not in PATHS:
        return argument
    start, _, text = match.groups()
    if "${" in text:
        if os.path.lexists(path := os.path.expanduser(text)):
            without_reference(Path(path))
        return argument
    paths = text.split(",") if multirun else [text]
    with suppress(HydraException):
        (override,) = parsed([argument])
        read = override.value()
        is_one = override.value_type == ValueType.SIMPLE_CHOICE_SWEEP and not multirun
        if (override.is_sweep_override() and not is_one) or read in (None, "", text):
            return argument
        # A folder's name may look like a number or a list.
        paths = [read if isinstance(read, str) else text]
    return start + ",".join(literal(os.path.expanduser(path)) for path in paths)


def _sweeps(texts: Sequence[str], config_dir: str | None) -> bool:
    """Whether a command without -m is a multirun, by an experiment; asked if a path has a comma."""
    paths = {text for text in texts if (word := KEY_VALUE.fullmatch(text)) and word[2] in PATHS}
    if not any("," in path for path in paths):
        return False
    with _config_loader() as loader, suppress(HydraException, OmegaConfBaseException):
        others = [*(text for text in texts if text not in paths), *_searchpath(config_dir)]
        config = loader.load_configuration(
            "config", others, RunMode.MULTIRUN, validate_sweep_overrides=False
        )
        return bool(config.hydra.mode == RunMode.MULTIRUN)
    return False


@contextmanager
def _config_loader() -> Iterator[ConfigLoader]:
    """A loader that composes configs before Hydra itself has begun."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


def _searchpath(config_dir: str | None) -> list[str]:
    """The override that has the effect of ``--config-dir``."""
    if config_dir is None:
        return []
    return [f"hydra.searchpath=[{literal(f'file://{os.path.abspath(config_dir)}')}]"]


def _says_how(override: Override) -> bool:
    """Whether an override is a training setting."""
    key = f"{override.key_or_group}."
    return any(key.startswith(f"{name}.") for name in TRAINING_KEYS)


def _defaults_of_scene(
    option: str | None, root: str, overrides: Sequence[Override], *, continued: bool
) -> list[str]:
    """Settings by the files of a scene, which ``data=option`` reads, that no override sets.

    Training settings are not among them if a run is ``continued``.

    Raises:
        DevrfError: ``option`` is None, and no reader knows the layout; or DeVRF, which nothing
            typed replaces, cannot learn the scene.
    """
    with importing():  # they load torch
        from devrf.data.kind import by_one_camera, faces_forward
        from devrf.scenes.formats import recognise

    words = []
    why = "its cameras"
    remark = ""
    if option is None:
        layout = recognise(root)
        option = layout.choice
        why = f"the layout of {layout.name}"
        remark = layout.remark
        words.append(f"data={option}")
    space = value(overrides, "data.space")
    if not values(overrides, "facing") and faces_forward(option, root, space):
        words.append("facing=forward")
    video = value(overrides, "data.monocular")
    ordered = value(overrides, "data.times") == "order"
    if video == "True" or (video is None and by_one_camera(option, root, ordered=ordered)):
        words += _for_one_camera(root, overrides, continued=continued)
    scene = Path(root).expanduser().resolve().name
    if value(overrides, "experiment") == "paper" and option in ("inward", "forward"):
        if (config_folder() / f"for_scene/paper_{scene}.yaml").is_file():
            line = f"{root}: if it is DeVRF's, data={scene} has what is published for it"
            applied_defaults.append(line)
    if words:
        applied_defaults.append(f"{root}: {why} ({' '.join(words)}){remark}")
    return words


def _for_one_camera(scene: str, overrides: Sequence[Override], *, continued: bool) -> list[str]:
    """The protocol for a monocular scene, by which a typed method learns it.

    There is none if a run is ``continued``; if DeVRF is asked for, the log says what it lacks.

    Raises:
        DevrfError: the run would learn it by DeVRF, though no training setting is typed.
    """
    method, stage = value(overrides, "method"), value(overrides, "stage")
    lacks = f"{scene}: one moving camera, and nothing at rest, which method=devrf needs"
    if method == "devrf" or stage in DEVRF_STAGES:
        applied_defaults.append(f"{lacks}; experiment=phone learns more of it")
    elif not continued and not any(map(_says_how, overrides)):
        line = f"{lacks}; give experiment=phone, on a GPU experiment=phone_gpu"
        if stage not in STEPS:
            raise DevrfError(line)
        applied_defaults.append(line)
    elif method and not any(values(overrides, key) for key in ("protocol", "comparison")):
        return ["protocol=dynamic"]
    return []


def _of_experiments(overrides: Sequence[Override], config_dir: str | None) -> list[str | None]:
    """The options of ``data`` that experiments choose, which may lie in other folders; or None."""
    names = values(overrides, "experiment")
    if not names:
        return [None]
    texts = [str(o.input_line) for o in overrides if o.key_or_group == "hydra.searchpath"]
    texts += _searchpath(config_dir)
    options: list[str | list[str] | None] = []
    with _config_loader() as loader:
        for name in names:
            with suppress(HydraException):  # reported when Hydra composes it
                words = [f"experiment={name}", *texts]
                defaults = loader.compute_defaults_list("config", words, RunMode.RUN)
                options.append(defaults.overrides.override_choices.get("data"))
    return [str(option) for option in options if option is not None] or [None]
