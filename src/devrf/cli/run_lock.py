"""One process at a time works in a run's folder.

The lock is the system's on an open file: it vanishes with the process, however that ends. Which
process has it stands beside it, for those who have to wait. Of several processes that learn one
scene together, the first has the lock for all.
"""

from __future__ import annotations

import json
import logging
import os
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, SoftFileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from devrf.cli.messages import REFUSED, report_user_errors
from devrf.errors import DevrfError
from devrf.system.files import write_json

log = logging.getLogger(__name__)

# Within the run's folder; it stays there, with an empty file to lock.
PLACE = ".devrf"
LOCK, OWNER = "lock", "process.json"
# Stages that write nothing into the folder of a run.
OF_OTHERS = ("report",)
# What torchrun and SLURM call the number of a process among those that they have started.
NUMBERS = ("RANK", "SLURM_PROCID")

# Hydra begins to write before it calls the program: a lock has to be handed over.
_held: dict[Path, FileLock] = {}


class RunDirLock(Callback):
    """Hydra's callback that locks a run's or a sweep's folder before anything is written there.

    Hydra passes over what a callback raises, but for an exit: the mistake is said here.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Lock the folder of a run; :func:`alone_in` finds it locked."""
        try:
            folder = _run_folder(config)
        except OmegaConfBaseException:
            return  # Hydra comes to say what is wrong with the config
        if _locks(config):
            with report_user_errors():
                _lock(folder, "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Lock the folder of a sweep; each of its jobs locks its own."""
        with report_user_errors():
            _lock(Path(config.hydra.sweep.dir), "hydra.sweep.dir")

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Let others work in the sweep's folder."""
        _unlock(Path(config.hydra.sweep.dir))


def _run_folder(config: DictConfig) -> Path:
    """Where Hydra will make the run's folder; it has not set itself up yet."""
    hydra = HydraConfig.instance()
    before = hydra.cfg
    try:
        hydra.set_config(config)
        return Path(config.hydra.run.dir)
    finally:
        hydra.cfg = before


def _locks(config: DictConfig) -> bool:
    """Whether the process works in a run's folder, and is the first of those that do together."""
    together = config.trainer.get("strategy") is not None
    follows = any(os.environ.get(name, "0") != "0" for name in NUMBERS)
    return config.stage not in OF_OTHERS and not (together and follows)


@contextmanager
def alone_in(folder: Path, config: DictConfig, key: str) -> Iterator[None]:
    """While the block lasts, no other process works in a run's folder.

    Args:
        folder: the run's folder.
        config: a composed config.
        key: the setting by which another folder is chosen, for the message.

    Raises:
        DevrfError: another process works there.
    """
    if not _locks(config):
        yield
        return
    if not _lock(folder, key):
        log.warning(
            "%s: its file system has no locks; see that no other process works there", folder
        )
    try:
        yield
    finally:
        _unlock(folder)


def _lock(folder: Path, key: str) -> bool:
    """Lock a folder unless this process has done so; False where its file system cannot."""
    if folder.resolve() in _held:
        return True
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / PLACE
    place.mkdir(exist_ok=True)
    lock = FileLock(place / LOCK)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            lock.acquire(timeout=0)
    except Timeout:
        raise DevrfError(
            f"{folder}: another devrf process{_owner(place / OWNER)} works in this folder; wait "
            f"for it, or use {key}=FOLDER"
        ) from None
    except NotImplementedError:
        return False
    except OSError as error:
        if error.errno in REFUSED:
            raise
        return False
    if isinstance(lock, SoftFileLock):
        # What filelock takes to without the system's locks: it would outlive a killed process.
        lock.release()
        return False
    _held[folder.resolve()] = lock
    since = datetime.now().astimezone().isoformat(" ", "seconds")
    write_json(place / OWNER, {"pid": os.getpid(), "host": socket.gethostname(), "since": since})
    return True


def _unlock(folder: Path) -> None:
    lock = _held.pop(folder.resolve(), None)
    if lock is not None:
        (folder / PLACE / OWNER).unlink(missing_ok=True)
        lock.release()


def _owner(file: Path) -> str:
    """Which process it is, in brackets; nothing in the moment before it has said so."""
    try:
        owner = json.loads(file.read_text())
        return f" (pid {owner['pid']} on {owner['host']}, since {owner['since']})"
    except (OSError, ValueError, LookupError, TypeError):
        return ""
