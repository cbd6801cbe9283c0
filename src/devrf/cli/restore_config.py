"""A run that knows itself: a later command begins from the overrides that it was learned with.

Each checkpoint holds the overrides of the command that learned it. They come before what is typed:
only what is typed differs.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf

from devrf.cli.config import OF_A_CHECKPOINT, scene_folder_name
from devrf.cli.messages import in_quotes
from devrf.errors import DevrfError

log = logging.getLogger(__name__)

# Overrides that say what to do with a run, on which machine, and what to log, not what the run is.
OF_A_COMMAND = {"stage", "ckpt", "resume", "memory_check", "objective", "hparams_search"}
OF_A_COMMAND |= {"hydra", "report", "still", "export", "trainer", "logger", "callbacks", "kernels"}
OF_A_COMMAND |= {"viewer"}
# Names code to be run, which a checkpoint, perhaps a stranger's, may not choose.
CODE = "_target_"
# Values that are relative to the folder in which they were typed.
RELATIVE = {"data.root", "evaluation.lpips_weights", "video.path"}

# Where the present command's settings come from, until a log is there to say so.
_source: list[str] = []


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


def recorded(overrides: Iterable[str]) -> list[str]:
    """What a checkpoint keeps of a command's overrides; paths of files are made absolute.

    What it keeps of these again is the same.

    Raises:
        HydraException: an override is not understood.
    """
    lasting = []
    for override in parsed(overrides):
        key, text = override.key_or_group, str(override.input_line)
        if _root(key) in OF_A_COMMAND or CODE in text:
            continue
        path = None if override.is_delete() else override.value()
        if key in RELATIVE and isinstance(path, str) and Path(path).expanduser().exists():
            text = f"{key}={in_quotes(str(Path(path).expanduser().absolute()))}"
        lasting.append(text)
    return lasting


def _root(key: str) -> str:
    """The first part of a key: ``data`` of ``data.root``."""
    return re.split("[./]", key)[0]


def log_source() -> None:
    """Say where the settings come from that were not typed."""
    for line in _source:
        log.info("%s", line)


def of_named_run(typed: Sequence[Override], multirun: bool) -> list[str]:
    """The overrides that the run was learned with which the command names, and its folder."""
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
    commands = [_command(path) for path in checkpoints if path.is_file()]
    if not commands or len(commands) < len(checkpoints):
        return []  # a file that is missing is reported by the step that loads it
    if None in commands:
        _source.append(
            f"{checkpoints[commands.index(None)]}: does not say how it was learned; data and "
            "settings are those typed, and the defaults"
        )
        return []
    known = [command or [] for command in commands]
    shared = [text for text in known[0] if all(text in command for command in known)]
    put = _beside(typed, shared, source)
    if multirun:
        # The sweep is the one that is typed, not that of an experiment.
        return put if values(typed, "hparams_search") else [*put, "hydra.sweeper.params=null"]
    put.append("hydra.mode=RUN")
    if folder is None and value(typed, "stage") in OF_A_CHECKPOINT:
        put.append(f"hydra.run.dir={in_quotes(str(_folder_for(checkpoints[0])))}")
    return put


def _of_sweep(typed: Sequence[Override], folder: Path) -> list[str]:
    """What the sweep in ``hydra.sweep.dir`` was started with, unless another is typed."""
    record = folder / "multirun.yaml"
    if any(override.is_sweep_override() for override in typed) or not record.is_file():
        return []
    begun = OmegaConf.select(OmegaConf.load(record), "hydra.overrides.task") or []
    return [*_beside(typed, recorded(begun), str(folder)), "hydra.mode=MULTIRUN"]


def _beside(typed: Sequence[Override], command: Sequence[str], source: str) -> list[str]:
    """The recorded overrides that stay beside what is typed.

    Another option of a group begins from its own values. Another method takes over data and seed.
    """
    before = parsed(command)
    keys = {override.key_or_group for override in typed if not override.is_add()}
    changed = tuple(f"{k}." for k in keys if values(typed, k) != values(before, k))
    method = value(typed, "method")
    other = method not in (None, value(before, "method") or "devrf")
    stay = []
    for override in before:
        key = override.key_or_group
        replaced = key.startswith(changed) or (key in keys and not override.is_add())
        if not replaced and (not other or _root(key) in ("data", "seed")):
            stay.append(str(override.input_line))
    if stay:
        _source.append(f"{source}: as it was learned, with {' '.join(stay)}")
    return stay


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


def _command(checkpoint: Path) -> list[str] | None:
    """The command that a checkpoint was learned with; None where it is not known."""
    from devrf.checkpoints.checkpoint import metadata_of  # loads torch

    # A damaged file is reported when the whole of it is read.
    with suppress(DevrfError, OSError, HydraException):
        command = metadata_of(checkpoint).command
        return None if command is None else recorded(command)
    return None
