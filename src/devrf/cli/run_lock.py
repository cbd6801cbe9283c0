"""One process at a time works in a run's folder.

The lock is the system's on an open file, so it ends with its process. A file beside it tells other
processes which one that is.
"""

from __future__ import annotations

import logging
import os
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
from devrf.system.files import atomic_write, make_folder

log = logging.getLogger(__name__)

# Within the run's folder; the lock file stays there, empty.
PLACE = ".devrf"
LOCK, OWNER = "lock", "process.txt"
# Environment variables in which torchrun and SLURM number the processes that they start.
RANKS = ("RANK", "SLURM_PROCID")

# Hydra writes before it calls the program, so its callback locks, and the program uses that lock.
_held: dict[Path, FileLock] = {}


class RunDirLock(Callback):
    """Hydra callback that locks the folder of a run or sweep before anything is written there.

    Hydra ignores what a callback raises, except an exit: errors are reported here.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Lock the folder of a run; :func:`exclusive` releases it."""
        hydra = HydraConfig.instance()
        before = hydra.cfg
        try:
            hydra.set_config(config)  # Hydra does so later, and the folder may refer to it
            folder = Path(config.hydra.run.dir)
        except OmegaConfBaseException:
            return  # Hydra will report what is wrong with the config
        finally:
            hydra.cfg = before
        with report_user_errors():
            make_folder(folder)  # as Hydra does next, with a traceback where it cannot
            if _locks(config):
                _lock(folder, "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Lock the folder of a sweep; each of its jobs locks its own."""
        with report_user_errors():
            _lock(Path(config.hydra.sweep.dir), "hydra.sweep.dir")

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Release the sweep's folder."""
        _release(Path(config.hydra.sweep.dir))


@contextmanager
def exclusive(folder: Path, config: DictConfig, key: str) -> Iterator[None]:
    """While the block lasts, no other process works in a run's folder.

    Args:
        folder: the run's folder.
        config: a composed config.
        key: the setting that chooses another folder, for the message.

    Raises:
        DevrfError: another process works there.
    """
    if _locks(config) and not _lock(folder, key):
        log.warning(
            "%s: its file system has no locks; see that no other process works there", folder
        )
    try:
        yield
    finally:
        _release(folder)


def _locks(config: DictConfig) -> bool:
    """Whether a process needs the lock: rank 0 locks for its workers.

    A report and the viewer only read, but for a camera path that is written at once; stage=fetch
    locks where it writes.
    """
    if config.stage in ("report", "fetch", "view"):
        return False
    worker = any(os.environ.get(name, "0") != "0" for name in RANKS)
    return not (worker and config.trainer.get("strategy") is not None)


def _lock(folder: Path, key: str) -> bool:
    """Lock a folder unless this process has done so; False where its file system cannot."""
    if folder.resolve() in _held:
        return True
    place = folder / PLACE
    make_folder(folder)
    place.mkdir(exist_ok=True)
    lock, owner = FileLock(place / LOCK), place / OWNER
    try:
        with warnings.catch_warnings(action="ignore"):
            lock.acquire(timeout=0)
    except Timeout:
        which = ""
        with suppress(OSError):  # the other process may not have written it yet
            which = f" ({owner.read_text()})"
        raise DevrfError(
            f"{folder}: another devrf process{which} works in this folder; wait for it, or use "
            f"{key}=FOLDER"
        ) from None
    except (NotImplementedError, OSError) as error:
        if isinstance(error, OSError) and error.errno in REFUSED:
            raise
        return False
    if isinstance(lock, SoftFileLock):  # filelock's substitute would outlive a killed process
        lock.release()
        return False
    _held[folder.resolve()] = lock
    since = datetime.now().astimezone().isoformat(" ", "seconds")
    with atomic_write(owner) as partial:
        partial.write_text(f"pid {os.getpid()} on {socket.gethostname()}, since {since}")
    return True


def _release(folder: Path) -> None:
    lock = _held.pop(folder.resolve(), None)
    if lock is not None:
        (folder / PLACE / OWNER).unlink(missing_ok=True)
        lock.release()
