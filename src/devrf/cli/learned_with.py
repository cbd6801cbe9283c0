"""What a run was learned with is what a later command in its folder begins from.

Each checkpoint holds the overrides of the command that learned it. A later command, in the folder
of the run (``hydra.run.dir=FOLDER``) or with ``ckpt=FILE``, is composed from these and, after
them, from what is typed: only what is typed differs. A command without either, whose stage needs
a checkpoint, looks for it in the folder that its own config gives.

With ``hydra.sweep.dir=FOLDER`` and nothing to sweep over, the jobs are those of the sweep there.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from devrf.cli.config import config_folder, scene_folder_name
from devrf.cli.overrides import Overrides, quoted, recorded, root_of, text_of
from devrf.cli.stages import OF_A_CHECKPOINT, PIPELINE, STEPS
from devrf.errors import DevrfError

log = logging.getLogger(__name__)

# Stages that a checkpoint is not looked for: they learn from nothing, or only read a scene.
FROM_NOTHING = {PIPELINE, *STEPS} - {*OF_A_CHECKPOINT}

# Where the present command's settings come from, until a log is there to say so.
_source: list[str] = []


def completed(arguments: Sequence[str]) -> list[str]:
    """The command line with what the run that it is about was learned with, before what is typed.

    Args:
        arguments: of the command line, without the program's name.
    """
    _source.clear()
    words = [a for a in arguments if not a.startswith("-") and ("=" in a or a.startswith("~"))]
    try:
        typed = Overrides.of(words)
    except HydraException:  # reported when Hydra parses them
        return list(arguments)
    multirun = not {"-m", "--multirun"}.isdisjoint(arguments)
    if typed.value("stage") == "report":
        return list(arguments)
    if typed.values("ckpt"):
        put = _of_checkpoints(typed, multirun)
    elif typed.values("hydra.sweep.dir"):
        put = _of_sweep(typed)
    else:
        put = [] if multirun else _of_folder(typed)
    if not put:
        return list(arguments)
    place = arguments.index(words[0])  # Hydra takes all overrides from one place
    return [*arguments[:place], *put, *arguments[place:]]


def log_source() -> None:
    """Say where the settings come from that were not typed."""
    for line in _source:
        log.info("%s", line)


def _of_checkpoints(typed: Overrides, multirun: bool) -> list[str]:
    """What the checkpoints ``ckpt`` have in common, and the folder of a single one's run."""
    paths = [Path(path) for path in typed.values("ckpt")]
    commands = [command for path in paths if (command := _command(path)) is not None]
    if len(commands) < len(paths):
        if all(path.is_file() for path in paths):
            _note_unknown(paths[0])
        return []
    shared = [one for one in commands[0] if all(one in other for other in commands)]
    put = _begin(typed, shared, ", ".join(map(str, paths)))
    if multirun:
        # The sweep is the one that is typed, not that of an experiment.
        search = typed.values("hparams_search")
        return put if search else [*put, "hydra.sweeper.params=null"]
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


def _of_sweep(typed: Overrides) -> list[str]:
    """What the sweep in ``hydra.sweep.dir`` was started with, unless another is typed."""
    folder = typed.value("hydra.sweep.dir")
    record = Path(folder or "") / "multirun.yaml"
    if typed.sweeps or not record.is_file():
        return []
    begun = OmegaConf.select(OmegaConf.load(record), "hydra.overrides.task") or []
    return [*_begin(typed, recorded(begun), str(folder)), "hydra.mode=MULTIRUN"]


def _of_folder(typed: Overrides) -> list[str]:
    """What the run in the command's folder was learned with."""
    given = typed.value("hydra.run.dir")
    if given is None and (typed.value("stage") or PIPELINE) in FROM_NOTHING:
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


def _composed_folder(typed: Overrides) -> Path | None:
    """The folder of the run that is typed; None for a first stage, or one that cannot be."""
    hydra = HydraConfig.instance()
    before = hydra.cfg
    try:
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            config = compose("config", typed.texts, return_hydra_config=True)
        hydra.set_config(config)
        stage = config.protocol.stages.get(config.stage)
        first = stage is not None and stage.get("builds_on") is None
        return None if first else Path(config.hydra.run.dir)
    except (HydraException, OmegaConfBaseException):  # reported when Hydra composes it
        return None
    finally:
        hydra.cfg = before


def _begin(typed: Overrides, command: Sequence[str], source: str) -> list[str]:
    """The recorded overrides that stay beside what is typed.

    Another option of a group begins from its own values. Another method takes over data and seed.
    """
    before = Overrides.of(command)
    keys = [one.key_or_group for one in typed.parsed if not one.is_add()]
    changed = [key for key in keys if typed.values(key) != before.values(key)]
    method = typed.value("method")
    other = method not in (None, before.value("method") or "devrf")
    stay = []
    for one in before.parsed:
        key = one.key_or_group
        replaced = any(key.startswith(f"{k}.") for k in changed)
        replaced |= key in keys and not one.is_add()
        if not replaced and (not other or root_of(one) in ("data", "seed")):
            stay.append(text_of(one))
    if stay:
        _source.append(f"{source}: as it was learned, with {' '.join(stay)}")
    return stay


def _command(checkpoint: Path) -> list[str] | None:
    """The command that a checkpoint was learned with; None where it is not known."""
    from devrf.checkpoints.checkpoint import metadata_of  # loads torch

    # A damaged file is reported when the whole of it is read.
    with suppress(DevrfError, OSError, HydraException):
        command = metadata_of(checkpoint).command
        return None if command is None else recorded(command)
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
