"""What a run was learned with is what a later command in its folder begins from.

Each checkpoint holds the overrides of the command that learned it. A later command, in the folder
of the run (``hydra.run.dir=FOLDER``) or with ``ckpt=FILE``, is composed from these and, after
them, from what is typed: only what is typed differs. A command without either, whose stage needs
a checkpoint, looks for it in the folder that its own config gives.

With ``hydra.sweep.dir=FOLDER`` and nothing to sweep over, the jobs are those of the sweep there.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from devrf.cli.config import config_folder, scene_folder_name
from devrf.errors import DevrfError

log = logging.getLogger(__name__)

# Overrides that say what to do with a run, not what it is; keys below the groups likewise.
OF_A_COMMAND = {"stage", "ckpt", "resume", "memory_check", "objective", "hparams_search"}
GROUPS_OF_A_COMMAND = {"hydra", "report", "still"}
# Values that are relative to the folder in which they were typed.
PATHS = {"data.root", "evaluation.lpips_weights"}
# Stages that a checkpoint is not looked for: they learn from nothing, or only read a scene.
FROM_NOTHING = {"pipeline", "inspect", "prepare", "report"}
# Stages that show or score a checkpoint, beside what it is the checkpoint of.
OF_A_CHECKPOINT = {"evaluate", "render", "still"}

# Where the present command's settings come from, until a log is there to say so.
_source: list[str] = []


@dataclass(frozen=True)
class _Typed:
    """The command line.

    Attributes:
        overrides: what is typed beside options.
        multirun: whether it asks for a sweep.
    """

    overrides: tuple[Override, ...]
    multirun: bool

    def values(self, key: str) -> list[str]:
        """The value of ``key``, of a sweep all of them; none where it is not typed."""
        for one in reversed(self.overrides):
            if one.key_or_group == key and not one.is_delete():
                if one.is_choice_sweep():
                    return [str(getattr(v, "text", v)) for v in one.sweep_iterator()]
                return [] if one.value() is None else [str(one.value())]
        return []

    def value(self, key: str) -> str | None:
        """The value of ``key``; None where it is not typed, or swept over."""
        values = self.values(key)
        return values[0] if len(values) == 1 else None


def completed(arguments: Sequence[str]) -> list[str]:
    """The command line with what the run that it is about was learned with, before what is typed.

    Args:
        arguments: of the command line, without the program's name.
    """
    _source.clear()
    words = [a for a in arguments if not a.startswith("-") and ("=" in a or a.startswith("~"))]
    try:
        overrides = tuple(OverridesParser.create().parse_overrides(words))
    except HydraException:  # reported when Hydra parses them
        return list(arguments)
    typed = _Typed(overrides, multirun=not {"-m", "--multirun"}.isdisjoint(arguments))
    if typed.value("stage") == "report":
        return list(arguments)
    if typed.values("ckpt"):
        put = _of_checkpoints(typed, [Path(path) for path in typed.values("ckpt")])
    elif typed.values("hydra.sweep.dir"):
        put = _of_sweep(typed)
    else:
        put = [] if typed.multirun else _of_folder(typed)
    if not put:
        return list(arguments)
    place = arguments.index(words[0])  # Hydra takes all overrides from one place
    return [*arguments[:place], *put, *arguments[place:]]


def log_source() -> None:
    """Say where the settings come from that were not typed."""
    for line in _source:
        log.info("%s", line)


def recorded(overrides: Iterable[str]) -> list[str]:
    """What a checkpoint keeps of a command's overrides; paths of files are made absolute."""
    kept = []
    for one in OverridesParser.create().parse_overrides(list(overrides)):
        key, value = one.key_or_group, None if one.is_delete() else one.value()
        if key in OF_A_COMMAND or re.split("[./]", key)[0] in GROUPS_OF_A_COMMAND:
            continue
        if key in PATHS and isinstance(value, str) and "${" not in value:
            kept.append(f"{key}={quoted(str(Path(value).expanduser().absolute()))}")
        else:
            kept.append(str(one.input_line))
    return kept


def value_in(overrides: Sequence[str], key: str) -> str | None:
    """The value that overrides give ``key``; None where they give none."""
    return _Typed(tuple(OverridesParser.create().parse_overrides(list(overrides))), False).value(
        key
    )


def quoted(text: str) -> str:
    """A value as Hydra's grammar takes it literally."""
    if re.fullmatch(r"[A-Za-z0-9_./-]+", text):
        return text
    escaped = text.replace("'", "\\'")
    return f"'{escaped}'"


def _of_checkpoints(typed: _Typed, paths: Sequence[Path]) -> list[str]:
    """What the checkpoints ``ckpt`` have in common, and the folder that they belong to."""
    commands = [command for path in paths if (command := _command(path)) is not None]
    if len(commands) < len(paths):
        if all(path.is_file() for path in paths):
            _note_unknown(paths[0])
        return []
    shared = [one for one in commands[0] if all(one in other for other in commands)]
    put = _begin(typed, shared, ", ".join(map(str, paths)))
    if typed.multirun:
        # The sweep is the one that is typed, not that of an experiment.
        sweeps = any(one.key_or_group == "hparams_search" for one in typed.overrides)
        return [*put, *([] if sweeps else ["hydra.sweeper.params=null"])]
    put.append("hydra.mode=RUN")
    stage = typed.value("stage")
    if stage in OF_A_CHECKPOINT and typed.value("hydra.run.dir") is None:
        put.append(f"hydra.run.dir={quoted(str(_folder_for(paths[0])))}")
    return put


def _folder_for(checkpoint: Path) -> Path:
    """Where what is made of a checkpoint goes.

    Into the folder of its run if it is the last of it, else into a folder below that has the
    checkpoint's name; of a file that stands alone, into ``outputs/<scene>/<name>``.
    """
    if checkpoint.parent.name == "checkpoints":
        run = checkpoint.parent.parent
        last = _last_checkpoint(run)
        same = last is not None and last.resolve() == checkpoint.resolve()
        return run if same else run / checkpoint.stem
    from devrf.checkpoints.checkpoint import metadata_of

    return Path("outputs") / scene_folder_name(metadata_of(checkpoint).scene) / checkpoint.stem


def _of_sweep(typed: _Typed) -> list[str]:
    """What the sweep in ``hydra.sweep.dir`` was started with, unless another is typed."""
    folder = typed.value("hydra.sweep.dir")
    record = Path(folder or "") / "multirun.yaml"
    if any(one.is_sweep_override() for one in typed.overrides) or not record.is_file():
        return []
    begun = OmegaConf.select(OmegaConf.load(record), "hydra.overrides.task") or []
    return [*_begin(typed, recorded(begun), str(folder)), "hydra.mode=MULTIRUN"]


def _of_folder(typed: _Typed) -> list[str]:
    """What the run in the command's folder was learned with."""
    given = typed.value("hydra.run.dir")
    if given is None and (typed.value("stage") or "pipeline") in FROM_NOTHING:
        return []
    folder = _composed_folder(typed) if given is None else Path(given)
    last = None if folder is None else _last_checkpoint(folder)
    if last is None:
        return []
    command = _command(last)
    if command is None:
        _note_unknown(last)
        return []
    put = [*_begin(typed, command, str(folder)), "hydra.mode=RUN"]
    return put if given is not None else [*put, f"hydra.run.dir={quoted(str(folder))}"]


def _composed_folder(typed: _Typed) -> Path | None:
    """The folder of the run that is typed; None for a first stage, or one that cannot be."""
    hydra = HydraConfig.instance()
    before = hydra.cfg
    overrides = [str(one.input_line) for one in typed.overrides]
    try:
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            config = compose("config", overrides, return_hydra_config=True)
        hydra.set_config(config)
        stage = config.protocol.stages.get(config.stage)
        first = stage is not None and stage.get("builds_on") is None
        return None if first else Path(config.hydra.run.dir)
    except (HydraException, OmegaConfBaseException):  # reported when Hydra composes it
        return None
    finally:
        hydra.cfg = before


def _begin(typed: _Typed, command: Sequence[str], source: str) -> list[str]:
    """The recorded overrides that stay beside what is typed.

    Another option of a group begins from its own values. Another method takes over data and seed.
    """
    parsed = OverridesParser.create().parse_overrides(list(command))
    before = _Typed(tuple(parsed), multirun=False)
    keys = [one.key_or_group for one in typed.overrides if not one.is_add()]
    changed = [key for key in keys if typed.values(key) != before.values(key)]
    method = typed.value("method")
    other = method not in (None, before.value("method") or "devrf")
    stay = []
    for one in parsed:
        key = one.key_or_group
        replaced = any(key.startswith(f"{k}.") for k in changed)
        replaced |= key in keys and not one.is_add()
        if not replaced and (not other or re.split("[./]", key)[0] in ("data", "seed")):
            stay.append(str(one.input_line))
    if stay:
        _source.append(f"{source}: as it was learned, with {' '.join(stay)}")
    return stay


def _command(checkpoint: Path) -> list[str] | None:
    """The command that a checkpoint was learned with; None where it is not known."""
    from devrf.checkpoints.checkpoint import metadata_of  # loads torch

    with suppress(DevrfError, OSError):  # reported when the whole file is read
        return metadata_of(checkpoint).command
    return None


def _last_checkpoint(run: Path) -> Path | None:
    """The checkpoint or progress file of the latest stage in a run's folder."""
    paths = sorted((run / "checkpoints").glob("*.ckpt"))
    if not paths:
        return None
    from devrf.checkpoints.checkpoint import metadata_of

    found: list[tuple[int, int, Path]] = []
    for path in paths:
        with suppress(DevrfError, OSError):
            found.append((len(metadata_of(path).records), path.stat().st_mtime_ns, path))
    return max(found)[2] if found else None


def _note_unknown(checkpoint: Path) -> None:
    _source.append(
        f"{checkpoint}: does not say how it was learned; data and settings are those typed, and "
        "the defaults"
    )
