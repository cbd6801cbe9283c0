"""A later command on a run begins from the settings of its training.

A checkpoint holds the options of config groups that were chosen, by ``/group``, and the values set
beside them, by config key, resolved. A later command sets the same, beneath what is typed, by
Hydra's own overrides. :func:`taken` alone says which of a file's keys these are: names of options,
and plain values; text is put in quotes, so that nothing in a file is read as an interpolation or as
code.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import repeat
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig

from devrf.checkpoints.file_metadata import latest_checkpoint
from devrf.cli.config import (
    OF_A_CHECKPOINT,
    PATHS,
    SCENELESS_STAGES,
    SWEEP_RECORD,
    choices,
    leaves,
    overrides,
    scene_folder_name,
)
from devrf.cli.config_check import RESERVED
from devrf.errors import DevrfError
from devrf.system.override import literal, to_type
from devrf.system.printed import is_shown
from devrf.system.process import importing

# Keys that say what to do with a run, on which machine, and what to log, not what the run is.
OF_A_COMMAND = {"stage", "ckpt", "resume", "memory_check", "objective", "hparams_search"}
OF_A_COMMAND |= {"hydra", "report", "still", "export", "trainer", "logger", "callbacks"}
OF_A_COMMAND |= {"viewer", "fetch", "capture", "prepare", "scene", "defaults"}
# Paths that a command writes to, and downloads.
PLACES = {"data.flow_cache", "evaluation.download"}
# Of another method's run these are taken over.
OF_A_SCENE = {"data", "facing", "seed"}
# Keys without a section.
ALONE = {"seed", "priors", "deterministic", "rehearse"}
# Groups whose options may sweep.
SWEEPERS = ("experiment", "hparams_search", "hydra/sweeper")
# An option's name leads to no other folder than its group's; a key is a path of plain names.
OPTION = re.compile(r"(?!null$)[\w-]+", re.ASCII | re.IGNORECASE)
KEY = re.compile(r"/?[\w-]+([./][\w-]+){0,15}", re.ASCII)
# Text that is more than text.
CODE = re.compile(rf"\$\{{|^\?\?\?$|{'|'.join(RESERVED)}")

# Keys of a command, and items of its lists, at most.
MOST = 1000
# Options by /group, values by key.
Command = dict[str, Any]


@dataclass(frozen=True)
class Applied:
    """Overrides that were not typed, and lines that say why they apply."""

    words: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)


def present_command(config: DictConfig) -> Command:
    """Options and values of the present command, but for those that only say what to do.

    Typed code (``_target_``) and removed keys are left out. Empty outside Hydra.
    """
    said: Command = {}
    options = choices()
    for override in parsed(overrides()):
        key = override.key_or_group
        if key in options:
            said[f"/{key}"] = options[key]
        elif not override.is_delete():
            said |= {".".join(names): value for names, value in leaves(config, key).items()}
    for key in PATHS & {*said}:  # relative to the folder in which they were typed
        if isinstance(said[key], str) and (path := Path(said[key])).exists():
            said[key] = str(path.absolute())
    return {key: value for key, value in said.items() if _is_known(key, value)}


def taken(source: Path, stored: Command, typed: Sequence[Override]) -> Command:
    """The part of a file's settings that applies beneath the typed overrides.

    Another option of a group begins from its own values; another method takes over the scene and
    the seed alone.

    Args:
        source: the file, which somebody else may have written.
        stored: its settings, by ``/group`` or config key.
        typed: the overrides of the present command.

    Raises:
        DevrfError: something else than a name of an option or a plain value is among them.
    """
    _check_length(source, stored.values())
    for key, setting in stored.items():
        if not _is_known(key, setting):
            said = f"{key}={setting}"[:80]
            raise DevrfError(f"{source}: {said!r} is no option or setting of a learned run")
    keys = {override.key_or_group for override in typed}
    other = tuple(f"{k}." for k in keys if value(typed, k) != stored.get(f"/{k}", ...))
    another = value(typed, "method") not in (None, stored.get("/method", "devrf"))
    return {
        key: setting
        for key, setting in stored.items()
        if key.lstrip("/") not in keys and not key.startswith(other)
        if not another or root(key) in OF_A_SCENE
    }


def _is_known(key: str, setting: object) -> bool:
    """Whether a run may have been learned with it: an option by name, or a plain value by key."""
    if not KEY.fullmatch(key) or root(key) in OF_A_COMMAND or key in PLACES:
        return False
    if RESERVED & {*key.split(".")}:
        return False
    if key.startswith("/"):
        return isinstance(setting, str) and OPTION.fullmatch(setting) is not None
    return ("." in key or key in ALONE) and _is_plain(setting)


def _is_plain(value: object, depth: int = 8) -> bool:
    """Whether a value is data: no code, nothing that refers to something else or is missing."""
    if isinstance(value, dict):
        value = [*value.keys(), *value.values()]
    if isinstance(value, list):
        return depth > 0 and all(_is_plain(item, depth - 1) for item in value)
    if isinstance(value, str):
        return is_shown(value) and not CODE.search(value)
    return value is None or isinstance(value, bool | int | float)


def root(key: str) -> str:
    """The first part of a key or group: ``data`` of ``data.root``."""
    return re.split("[./]", key.lstrip("/"))[0]


def as_typed(command: Mapping[str, Any]) -> list[str]:
    """The command as it may be typed without a shell."""
    said = {k: v if isinstance(v, str) else json.dumps(v) for k, v in command.items()}
    return [f"{key.lstrip('/')}={value}" for key, value in said.items()]


def parsed(overrides: Iterable[str]) -> list[Override]:
    """Overrides by Hydra's grammar.

    Raises:
        HydraException: one is not understood.
        DevrfError: there are too many values for the parser, which would take minutes.
    """
    words = list(overrides)
    _check_length("the command", words)
    return [_parsed_word(word) for word in words]


@lru_cache(MOST)  # a command's words are read in several places
def _parsed_word(word: str) -> Override:
    (override,) = OverridesParser.create().parse_overrides([word])
    return override


def _check_length(where: object, words: Iterable[object]) -> None:
    texts = [*map(str, words)]
    if sum(1 + text.count(",") for text in texts) > MOST or sum(map(len, texts)) > 100 * MOST:
        raise DevrfError(f"{where}: more than {MOST} values; give fewer, or shorter ones")


def values(overrides: Sequence[Override], key: str) -> list[str]:
    """The last value of ``key``, of a sweep all of them; none where there is none."""
    for override in reversed(overrides):
        if override.key_or_group != key or override.is_delete():
            continue
        if override.is_choice_sweep():
            return [str(getattr(value, "text", value)) for value in override.sweep_iterator()]
        is_set = not override.is_sweep_override() and override.value() is not None
        return [str(override.value())] if is_set else []
    return []


def value(overrides: Sequence[Override], key: str) -> str | None:
    """The last value of ``key``; None where there is none, or several."""
    texts = values(overrides, key)
    return texts[0] if len(texts) == 1 else None


def of_named_run(typed: Sequence[Override], multirun: bool) -> Applied:
    """The overrides of the training of the run that the command names.

    Raises:
        DevrfError: a checkpoint's command has more than options and plain values.
    """
    checkpoints = [Path(path) for path in values(typed, "ckpt")]
    folder = value(typed, "hydra.run.dir")
    sweep = value(typed, "hydra.sweep.dir")
    if value(typed, "stage") == "report":
        return Applied([] if sweep is None else [f"report.runs={literal(sweep)}"])
    if not checkpoints and (folder is None or multirun):
        return Applied()
    if not checkpoints and (last := latest_checkpoint(Path(str(folder)))):
        checkpoints = [last]
    if not checkpoints or not all(path.is_file() for path in checkpoints):
        return Applied()  # a file that is missing is reported by the step that loads it
    with importing():  # it loads torch
        from devrf.checkpoints.checkpoint import metadata_of
    commands = [metadata_of(path).command for path in checkpoints]
    first, *others = map(taken, checkpoints, commands, repeat(typed))
    shared = {k: v for k, v in first.items() if all(other.get(k, ...) == v for other in others)}
    remarks = []
    if shared or {} in commands:
        words = [to_type(key.lstrip("/"), setting) for key, setting in shared.items()]
        unknown = "does not say how it was learned; what is typed and the defaults apply"
        said = unknown if {} in commands else f"as it was learned, with {' '.join(words)}"
        remarks = [f"{', '.join(map(str, checkpoints))}: {said}"]
    put = [
        f"{key[1:]}={setting}" if key[0] == "/" else f"++{key}={literal(setting)}"
        for key, setting in shared.items()
    ]
    if multirun:
        # The sweep is the one that is typed, not that of an experiment.
        put += [] if values(typed, "hparams_search") else ["hydra.sweeper.params=null"]
        return Applied(put, remarks)
    put.append("hydra.mode=RUN")
    if folder is None and value(typed, "stage") in OF_A_CHECKPOINT:
        there = _folder_for(checkpoints[0], value(typed, "outputs"))
        put.append(f"hydra.run.dir={literal(str(there))}")
    return Applied(put, remarks)


def runs_of_sweep(typed: Sequence[Override]) -> list[Path]:
    """The learned runs of the sweep in ``hydra.sweep.dir``, in the order of their numbers.

    There are none if a sweep is typed.

    Raises:
        DevrfError: the sweep has no learned run.
    """
    folder = Path(value(typed, "hydra.sweep.dir") or "")
    sweeps = any(o.is_sweep_override() or o.key_or_group in SWEEPERS for o in typed)
    of_a_scene = value(typed, "stage") not in SCENELESS_STAGES
    if sweeps or not of_a_scene or not (folder / SWEEP_RECORD).is_file():
        return []
    runs = [path for path in folder.glob("[0-9]*_*/") if latest_checkpoint(path)]
    if not runs:
        raise DevrfError(f"{folder}: a sweep without a learned run; type the sweep again")
    return sorted(runs, key=lambda path: int(re.split(r"\D", path.name)[0]))


def _folder_for(checkpoint: Path, outputs: str | None) -> Path:
    """The folder for products of a checkpoint.

    It is the folder of its run if it is the last of it, else a folder below that has the
    checkpoint's name; of a file that stands alone, ``<outputs>/<scene>/<name>``.
    """
    from devrf.checkpoints.checkpoint import metadata_of

    run = Path(outputs or "outputs") / scene_folder_name(metadata_of(checkpoint).scene)
    if checkpoint.parent.name == "checkpoints":
        run = checkpoint.parent.parent
        if latest_checkpoint(run) == checkpoint:
            return run
    return run / checkpoint.stem
