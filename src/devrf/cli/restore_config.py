"""A run that knows itself: a later command begins from what it was learned with.

A checkpoint holds the options of config groups that were chosen, by ``/group``, and what was set
beside them, by config key, as plain values. A later command chooses the same options by name, and
Hydra merges the rest, as a config file of values alone, beneath what is typed: only that differs.
So nothing that a file says is read as an override, as an interpolation or as code.
"""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from devrf.cli.config import (
    OF_A_CHECKPOINT,
    RESTORED,
    choices,
    config_folder,
    group_choices,
    overrides,
    overrides_in,
    scene_folder_name,
)
from devrf.cli.config_check import RESERVED
from devrf.cli.messages import in_quotes
from devrf.errors import DevrfError

log = logging.getLogger(__name__)

# What says what to do with a run, on which machine, and what to log, not what the run is.
OF_A_COMMAND = {"stage", "ckpt", "resume", "memory_check", "objective", "hparams_search"}
OF_A_COMMAND |= {"hydra", "report", "still", "export", "trainer", "logger", "callbacks"}
OF_A_COMMAND |= {"viewer", "fetch", "capture", "selfcheck", "scene", "defaults"}
# Where a command writes, and what it fetches.
PLACES = {"data.export", "data.flow_cache", "evaluation.download"}
# Of another method's run these are taken over.
OF_A_SCENE = {"data", "facing", "seed"}
# What is set without a section.
ALONE = {"seed", "priors", "deterministic", "decoder_precision"}
# An option's name leads to no other folder than its group's; a key is a path of plain names.
OPTION = re.compile(r"(?!null$)[\w-]+", re.ASCII | re.IGNORECASE)
GROUP = re.compile(r"/[\w-]+(/[\w-]+)*", re.ASCII)
KEY = re.compile(r"[\w-]+(\.[\w-]+){0,16}", re.ASCII)
# Values that are relative to the folder in which they were typed.
RELATIVE = {"data.root", "evaluation.lpips_weights", "video.path"}
# Where Hydra finds the settings: a group below hydra/ is none of the run's own choices.
GROUP_OF_SETTINGS = "hydra/restored"

# Values of a key in a sweep, at most.
MOST_JOBS = 10_000

# Options by /group, values by key.
Command = dict[str, Any]

# Where the present command's settings come from, until a log is there to say so.
_source: list[str] = []
# The folder of the present command's restored settings.
_folder: list[TemporaryDirectory[str]] = []


def present_command(config: DictConfig) -> Command:
    """What the present command chose and set, but for what says only what to do.

    Code that was typed (``_target_``), and keys that were removed, are not kept. Empty outside
    Hydra.
    """
    if not HydraConfig.initialized():
        return {}
    known = [override for override in parsed(overrides()) if override.key_or_group in choices()]
    typed = [override for override in known if not override.is_delete()]
    chosen = {f"/{o.key_or_group}": o.value() for o in typed if o.value() and not o.is_add()}
    # Those alone, to compare with.
    found_in = [text for text in HydraConfig.get().overrides.hydra if "hydra.searchpath" in text]
    app = GlobalHydra.instance().is_initialized()  # not in another process of a sweep
    with nullcontext() if app else initialize_config_dir(str(config_folder()), version_base="1.3"):
        alone = compose("config", [*found_in, *(str(o.input_line) for o in typed)])
    changed = differing(OmegaConf.to_container(config), OmegaConf.to_container(alone))
    settings = {key: _plain_at(config, key) for key in changed if KEY.fullmatch(key)}
    return {
        **{group: option for group, option in chosen.items() if not _of_a_command(group)},
        **{key: value for key, value in settings.items() if _is_plain(value)},
    }


def differing(now: Any, before: Any, path: str = "") -> Iterator[str]:
    """The keys of values in one config that another has not; of lists the whole, of code none."""
    for key, value in now.items():
        old, where = before.get(key, RESERVED), f"{path}{key}"
        if _of_a_command(where):
            continue
        if isinstance(value, Mapping):
            old = old if isinstance(old, Mapping) else {}
            if value.get("_target_") == old.get("_target_"):
                yield from differing(value, old, f"{where}.")
        elif value != old:
            yield where


def _plain_at(config: DictConfig, key: str) -> Any:
    """A value of a config, resolved; a path absolute where it exists."""
    value = OmegaConf.select(config, key)
    if OmegaConf.is_config(value):
        return OmegaConf.to_container(value, resolve=True)
    if key in RELATIVE and isinstance(value, str) and Path(value).expanduser().exists():
        return str(Path(value).expanduser().absolute())
    return value


def checked(path: Path, command: Mapping[str, Any]) -> Command:
    """What the file at ``path`` says, if these are names of options and plain values.

    Raises:
        DevrfError: something else is among them.
    """
    for key, value in command.items():
        if GROUP.fullmatch(key):
            known = isinstance(value, str) and OPTION.fullmatch(value) is not None
        else:
            known = KEY.fullmatch(key) is not None and _is_plain(value)
            known = known and ("." in key or key in ALONE)
        if not known or _of_a_command(key):
            said = f"{key}={value}"[:80]
            raise DevrfError(f"{path}: {said!r} is no option or setting of a learned run")
        if isinstance(value, Mapping):
            checked(path, {f"{key}.{name}": below for name, below in value.items()})
    return {**command}


def _is_plain(value: object, depth: int = 16) -> bool:
    """Whether a value is data: no code, nothing that refers to something else or is missing."""
    if isinstance(value, Mapping):
        names = all(isinstance(k, str) and KEY.fullmatch(k) and k not in RESERVED for k in value)
        return names and _is_plain(list(value.values()), depth)
    if isinstance(value, list):
        return depth > 0 and all(_is_plain(item, depth - 1) for item in value)
    if isinstance(value, str):
        return "${" not in value and value != "???" and value.isprintable() and len(value) < 5000
    return value is None or isinstance(value, bool | int | float)


def _of_a_command(key: str) -> bool:
    """Whether a key or group says only what to do, or builds a part."""
    return root(key) in OF_A_COMMAND or key in PLACES or bool(RESERVED & {*key.split(".")})


def root(key: str) -> str:
    """The first part of a key or group: ``data`` of ``data.root``."""
    return re.split("[./]", key.lstrip("/"))[0]


def as_typed(command: Mapping[str, Any]) -> list[str]:
    """It as it may be typed, for people."""
    said = {k: v if isinstance(v, str) else json.dumps(v) for k, v in command.items()}
    return [f"{key.lstrip('/')}={value}" for key, value in said.items()]


def parsed(overrides: Iterable[str]) -> list[Override]:
    """Overrides by Hydra's grammar.

    Raises:
        HydraException: one is not understood.
    """
    read: list[Override] = OverridesParser.create().parse_overrides(list(overrides))
    return read


def values(overrides: Sequence[Override], key: str) -> list[str]:
    """The last value of ``key``, of a sweep all of them; none where there is none."""
    for override in reversed(overrides):
        if override.key_or_group == key and not override.is_delete():
            if override.is_choice_sweep():
                return [str(getattr(v, "text", v)) for v in override.sweep_iterator()]
            return [] if override.value() is None else [str(override.value())]
    return []


def value(overrides: Sequence[Override], key: str) -> str | None:
    """The last value of ``key``; None where there is none, or several."""
    texts = values(overrides, key)
    return texts[0] if len(texts) == 1 else None


def log_source() -> None:
    """Say where the settings come from that were not typed."""
    for line in _source:
        log.info("%s", line)


def of_named_run(typed: Sequence[Override], multirun: bool) -> list[str]:
    """The overrides that take over what the run was learned with which the command names.

    Raises:
        DevrfError: a checkpoint says what is no option or plain value.
    """
    _source.clear()
    checkpoints = [Path(path) for path in values(typed, "ckpt")]
    folder, sweep = value(typed, "hydra.run.dir"), value(typed, "hydra.sweep.dir")
    if value(typed, "stage") == "report":
        return []
    if sweep is not None and not checkpoints:
        return _of_sweep(typed, Path(sweep))
    source = ", ".join(map(str, checkpoints))
    if folder is not None and not checkpoints and not multirun:
        from devrf.checkpoints.checkpoint import latest_checkpoint  # loads torch

        source = folder
        if (last := latest_checkpoint(Path(folder))) is not None:
            checkpoints = [last]
    if not checkpoints or not all(path.is_file() for path in checkpoints):
        return []  # a file that is missing is reported by the step that loads it
    commands = [_command_of(path) for path in checkpoints]
    if {} in commands:
        said = "does not say how it was learned; data and settings are those typed, and the"
        _source.append(f"{checkpoints[commands.index({})]}: {said} defaults")
        return []
    first = commands[0]
    shared = {k: first[k] for k in first if all(c.get(k, RESERVED) == first[k] for c in commands)}
    put = _put(beneath(typed, shared), typed, source, multirun=multirun)
    if multirun:
        # The sweep is the one that is typed, not that of an experiment.
        return put if values(typed, "hparams_search") else [*put, "hydra.sweeper.params=null"]
    put.append("hydra.mode=RUN")
    if folder is None and value(typed, "stage") in OF_A_CHECKPOINT:
        put.append(f"hydra.run.dir={in_quotes(str(_folder_for(checkpoints[0])))}")
    return put


def beneath(typed: Sequence[Override], command: Command) -> Command:
    """What stays beneath what is typed.

    Another option of a group begins from its own values. Another method takes over the scene
    and the seed alone.
    """
    keys = {override.key_or_group for override in typed}
    other = tuple(f"{k}." for k in keys if value(typed, k) != command.get(f"/{k}"))
    method = value(typed, "method")
    another = method not in (None, command.get("/method", "devrf"))
    return {
        key: setting
        for key, setting in command.items()
        if key.lstrip("/") not in keys and not key.startswith(other)
        if not another or root(key) in OF_A_SCENE
    }


def _put(command: Command, typed: Sequence[Override], source: str, *, multirun: bool) -> list[str]:
    """The overrides that take over a command; its settings go into a config file of values."""
    if not command:
        return []
    _source.append(f"{source}: as it was learned, with {' '.join(as_typed(command))}")
    put = [f"{key[1:]}={option}" for key, option in command.items() if key[0] == "/"]
    settings = OmegaConf.create()
    for key, setting in command.items():
        if key[0] != "/":
            OmegaConf.update(settings, key, setting, force_add=True)
    if settings:
        if multirun:  # other machines may take its jobs
            Path("outputs").mkdir(exist_ok=True)
        place = TemporaryDirectory(dir="outputs" if multirun else None, prefix=RESTORED)
        _folder[:] = [place]  # until the command ends
        file = Path(place.name, GROUP_OF_SETTINGS, "run.yaml")
        file.parent.mkdir(parents=True)
        file.write_text(f"# @package _global_\n{OmegaConf.to_yaml(settings)}", encoding="utf-8")
        paths = [f"file://{Path(place.name).absolute()}"]
        for override in typed:  # Hydra takes the first list of folders
            if override.key_or_group == "hydra.searchpath":
                paths += override.value()  # type: ignore[arg-type]
        put += [
            f"hydra.searchpath=[{','.join(map(in_quotes, paths))}]",
            f"+{GROUP_OF_SETTINGS}=run",
        ]
    return put


def _of_sweep(typed: Sequence[Override], folder: Path) -> list[str]:
    """What the sweep in ``hydra.sweep.dir`` was started with, unless another is typed.

    Raises:
        DevrfError: its record holds more than names of options and plain values.
    """
    record = folder / "multirun.yaml"
    if any(override.is_sweep_override() for override in typed) or not record.is_file():
        return []
    groups = group_choices()
    swept: list[str] = []
    command: Command = {}
    for override in parsed(overrides_in(record)):
        key = override.get_key_element().lstrip("+")
        if _of_a_command(key) or override.is_delete():
            continue
        name = f"/{key}" if key in groups else key
        if not override.is_sweep_override():
            command |= checked(record, {name: override.value()})
            continue
        sweep: Any = override.value()
        if override.is_range_sweep():
            count = (sweep.stop - sweep.start) / (sweep.step or 1)
        else:
            count = len(sweep.list) if override.is_choice_sweep() else math.inf
        if not count <= MOST_JOBS:
            raise DevrfError(f"{record}: {key} is no list of values; type the sweep again")
        try:
            texts = [parsed([f"{key}={text}"])[0].value() for text in override.sweep_iterator()]
        except HydraException:
            raise DevrfError(f"{record}: {key} has several mappings; type the sweep") from None
        for text in texts:
            checked(record, {name: text})
        if not values(typed, key):
            said = (
                in_quotes(text) if isinstance(text, str) else json.dumps(text) for text in texts
            )
            swept.append(f"{key}={','.join(said)}")
    put = _put(beneath(typed, command), typed, str(folder), multirun=True)
    return [*put, *swept, "hydra.mode=MULTIRUN"]


def _folder_for(checkpoint: Path) -> Path:
    """Where what is made of a checkpoint goes.

    Into the folder of its run if it is the last of it, else into a folder below that has the
    checkpoint's name; of a file that stands alone, into ``outputs/<scene>/<name>``.
    """
    from devrf.checkpoints.checkpoint import latest_checkpoint, metadata_of

    if checkpoint.parent.name == "checkpoints":
        run = checkpoint.parent.parent
        last = latest_checkpoint(run)
        same = last is not None and last.resolve() == checkpoint.resolve()
        return run if same else run / checkpoint.stem
    return Path("outputs") / scene_folder_name(metadata_of(checkpoint).scene) / checkpoint.stem


def _command_of(checkpoint: Path) -> Command:
    """The command that a checkpoint was learned with; empty where it does not say.

    Raises:
        DevrfError: the file is none of devrf's, or says what is no option or plain value.
    """
    from devrf.checkpoints.checkpoint import metadata_of  # loads torch

    return checked(checkpoint, metadata_of(checkpoint).command)
