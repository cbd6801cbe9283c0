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
from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from devrf.cli.config import PATHS, SCENELESS_STAGES, STEPS, config_folder, group_choices
from devrf.cli.config_check import NEEDED
from devrf.cli.restore_config import (
    Applied,
    of_named_run,
    parsed,
    runs_of_sweep,
    value,
    values,
)
from devrf.cli.view import serves_page
from devrf.errors import DevrfError, did_you_mean
from devrf.system.override import literal, without_reference
from devrf.system.process import importing

# Stages of DeVRF's protocol alone.
DEVRF_STAGES = ("canonical", "deformation")
# Keys that say how a scene without a static set is learned, or that a part of it is at rest.
CHOICES = ("method", "profile", "protocol", "comparison", "experiment", "data.static_until")
# `viewer` is a group, whose choices Hydra wants to be text; so it does of these.
SHORTHAND = {f"viewer={value}": f"viewer.training={value}" for value in ("true", "false")}
SHORTHAND |= {f"{group}=null": f"~{group}" for group in ("logger", "callbacks")}
KEY_VALUE = re.compile(r"(\+{0,2}([\w./@-]+)=)(.*)", re.DOTALL)


def commands(arguments: Sequence[str]) -> list[list[str]]:
    """The commands that typed arguments stand for: on the folder of a sweep, one for each run.

    Raises:
        DevrfError: no run of the sweep has learned anything.
    """
    named = [word for word in arguments if word.startswith("hydra.sweep.dir=")]
    runs: list[Path] = []
    if named:
        options, _ = get_args_parser().parse_known_intermixed_args(arguments)
        with suppress(HydraException):  # reported when Hydra parses them
            runs = runs_of_sweep(parsed(map(quoted_path, options.overrides)))
    others = [word for word in arguments if word not in (*named, "-m", "--multirun")]
    return [[*others, f"hydra.run.dir={literal(str(run))}"] for run in runs] or [[*arguments]]


def completed(arguments: Sequence[str]) -> Applied:
    """The command line for Hydra to compose, by typed arguments, without the program's name.

    The remarks say where settings are from that were not typed.

    Raises:
        DevrfError: a scene's folder cannot be recognised, the scenes of a sweep need different
            options, a scene is none for DeVRF, a group's choice is null, or a word is another
            framework's.
    """
    options, unknown = get_args_parser().parse_known_intermixed_args(arguments)
    for word in unknown:
        meant = word.lstrip("-") if "=" in word else "KEY=VALUE, without dashes"
        raise DevrfError(f"{word}: no such option; write {meant}, or --help for what there is")
    if options.experimental_rerun is not None:
        raise DevrfError("--experimental-rerun: a pickle may run code; write hydra.run.dir=FOLDER")
    flags = [word for word in arguments if word not in options.overrides]
    texts = [quoted_path(SHORTHAND.get(word.lower(), word)) for word in options.overrides]
    try:
        typed = parsed(texts)
    except HydraException:  # reported when Hydra parses them
        return Applied([*flags, *texts])
    for override in typed:
        names = group_choices().get(override.key_or_group)
        one = not override.is_delete() and not override.is_sweep_override()
        if names and one and not isinstance(override.value(), str | list):
            line = override.input_line
            raise DevrfError(f"{line}: choose one of {', '.join(names)}, or leave it out")
        if override.is_delete() and override.key_or_group in NEEDED:
            kept = f"{override.key_or_group} cannot be left out; change values below it, or its own"
            raise DevrfError(f"{override.input_line}: {kept} (--cfg job shows them)")
        _check_optional(override, options.config_dir, typed)
        if override.key_or_group == "debug":
            raise DevrfError(
                f"{override.input_line}: no such group; rehearse=true takes every step in minutes, "
                "+trainer.fast_dev_run=true a step of each stage"
            )
    run = value(typed, "hydra.run.dir")
    if run is not None and serves_page(typed, Path(run)):
        return Applied([*flags, *texts])
    before = of_named_run(typed, options.multirun)
    overrides = parsed([*before.words, *texts])
    by_scene = _of_scenes(typed, overrides, options.config_dir)
    words = [*flags, *before.words, *texts, *by_scene.words]
    return Applied(words, before.remarks + by_scene.remarks)


def _check_optional(override: Override, config_dir: str | None, typed: Sequence[Override]) -> None:
    """Refuse a misspelt ``for_scene``: Hydra passes over an option that is optional, and absent."""
    if config_dir is not None or values(typed, "hydra.searchpath"):
        return  # other folders may have it
    known = group_choices()["for_scene"]
    for name in values([override], "for_scene"):
        if name not in known:
            meant = did_you_mean(name, known, "for_scene=")
            names = ", ".join(known)
            raise DevrfError(f"for_scene={name}: no such option; choose one of {names}{meant}")


def _of_scenes(
    typed: Sequence[Override], overrides: Sequence[Override], config_dir: str | None
) -> Applied:
    """Settings by the scenes that the overrides name, which are the typed ones and a run's."""
    if value(overrides, "stage") in SCENELESS_STAGES:
        return Applied()
    if value(overrides, "data.camera") == "handheld":
        found = _for_one_camera("data.camera=handheld", overrides)
        line = f"data.camera=handheld: one camera ({' '.join(found.words)})"
        return Applied(found.words, found.remarks + [line] * bool(found.words))
    roots = values(typed, "data.root")
    if any("${" in root for root in roots):
        return Applied()
    readers: list[str | None] = [*values(overrides, "data")]
    readers = readers or (_of_experiments(overrides, config_dir) if roots else [])
    scenes = [
        _defaults_of_scene(reader, root, overrides) for reader, root in product(readers, roots)
    ]
    if any(scene.words != scenes[0].words for scene in scenes):
        needed = " and ".join(dict.fromkeys(" ".join(s.words) or "neither" for s in scenes))
        raise DevrfError(f"data.root: the scenes need {needed}; sweep over those of each apart")
    remarks = [line for scene in scenes for line in scene.remarks]
    return Applied(scenes[0].words if scenes else [], remarks)


def quoted_path(argument: str) -> str:
    """An argument as typed; if it names a file, as Hydra's grammar takes just that name.

    A comma separates paths, as it does other values, unless it is in the name of one that is there.

    Raises:
        DevrfError: it names nothing, or a file that no config can hold.
    """
    match = KEY_VALUE.fullmatch(argument)
    if not match or match[2] not in PATHS:
        return argument
    start, _, text = match.groups()
    is_there = os.path.lexists(path := os.path.expanduser(text))
    if "${" in text:
        if is_there:
            without_reference(Path(path))
        return argument
    paths = [text] if is_there else text.split(",")
    with suppress(HydraException):
        (override,) = parsed([argument])
        read = override.value()
        if read == "":
            raise DevrfError(f"{argument}: names nothing; give a path, or leave it out")
        if read in (None, text) or (override.is_sweep_override() and not is_there):
            return argument
        # A folder's name may look like a number or a list.
        paths = [read if isinstance(read, str) else text]
    return start + ",".join(literal(os.path.expanduser(path)) for path in paths)


def _defaults_of_scene(option: str | None, root: str, overrides: Sequence[Override]) -> Applied:
    """Settings by the files of a scene, which ``data=option`` reads, that no override sets.

    Raises:
        DevrfError: ``option`` is None, and no reader knows the layout; or DeVRF, which nothing
            typed replaces, cannot learn the scene.
    """
    with importing():  # they load torch
        from devrf.data.kind import by_one_camera, faces_forward
        from devrf.scenes.formats import recognise

    words: list[str] = []
    remarks: list[str] = []
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
    ordered = value(overrides, "data.times") == "order"
    video = value(overrides, "data.monocular")
    if video == "True" or (video is None and by_one_camera(option, root, ordered=ordered)):
        monocular = _for_one_camera(root, overrides)
        words += monocular.words
        remarks += monocular.remarks
    if value(overrides, "experiment") == "paper" and option in ("inward", "forward"):
        scene = Path(root).expanduser().resolve().name
        if f"paper_{scene}" in group_choices()["for_scene"]:
            remarks.append(f"{root}: if it is DeVRF's, data={scene} has what is published for it")
    if words:
        remarks.append(f"{root}: {why} ({' '.join(words)}){remark}")
    return Applied(words, remarks)


def _for_one_camera(scene: str, overrides: Sequence[Override]) -> Applied:
    """The protocol for a monocular scene, by which a typed method learns it.

    Raises:
        DevrfError: the run would learn it by DeVRF, though nothing typed says so.
    """
    method, stage = value(overrides, "method"), value(overrides, "stage")
    lacks = f"{scene}: one moving camera, and nothing at rest, which method=devrf needs"
    if method == "devrf" or stage in DEVRF_STAGES:
        return Applied([], [f"{lacks}; experiment=phone learns more of it"])
    if not any(values(overrides, key) for key in CHOICES):
        line = f"{lacks}; give experiment=phone, on a GPU experiment=phone_gpu"
        if stage not in STEPS:
            raise DevrfError(line)
        return Applied([], [line])
    if method and not any(values(overrides, key) for key in ("protocol", "comparison")):
        return Applied(["protocol=dynamic"])
    return Applied()


def _of_experiments(overrides: Sequence[Override], config_dir: str | None) -> list[str | None]:
    """The options of ``data`` that experiments choose, which may lie in other folders; or None."""
    searched = [str(o.input_line) for o in overrides if o.key_or_group == "hydra.searchpath"]
    if config_dir is not None:
        searched.append(f"hydra.searchpath=[{literal(f'file://{os.path.abspath(config_dir)}')}]")
    chosen: list[str | None] = []
    for name in values(overrides, "experiment"):
        with (
            suppress(HydraException, OmegaConfBaseException),  # reported when Hydra composes it
            initialize_config_dir(str(config_folder()), version_base="1.3"),
        ):
            words = [f"experiment={name}", *searched]
            config = compose("config", words, return_hydra_config=True)
            # Where an experiment does not choose, the scene is embedded, and has no folder.
            if "root" in config.data.keys():  # also one that is still to be typed
                chosen.append(str(config.hydra.runtime.choices.data))
    return chosen or [None]
