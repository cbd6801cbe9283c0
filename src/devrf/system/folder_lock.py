"""A folder in which one process works at a time.

The lock is the system's on an open file, so it ends with its process. A file beside it tells other
processes which one that is.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from devrf.errors import DevrfError
from devrf.system.files import REFUSED

log = logging.getLogger(__name__)

# Within the folder; the lock file stays there, empty.
PLACE = ".devrf"
LOCK, OWNER = "lock", "process.txt"

_held: dict[Path, FileLock] = {}


def lock_folder(folder: Path, key: str) -> None:
    """Lock a folder, unless this process holds it; a file system without locks gets a warning.

    Args:
        folder: the folder, which is made.
        key: the setting that chooses another folder.

    Raises:
        DevrfError: another process works there, or nothing can be written there.
    """
    if folder.resolve() in _held:
        return
    lock_files = folder / PLACE
    lock, owner = FileLock(lock_files / LOCK), lock_files / OWNER
    try:
        lock_files.mkdir(parents=True, exist_ok=True)
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
        # Where the system alone makes folders, as in /proc, there is no such file.
        if isinstance(error, OSError) and error.errno in {*REFUSED, errno.ENOENT}:
            raise DevrfError(
                f"{folder}: cannot be written ({error.strerror}); use {key}=FOLDER"
            ) from None
        log.warning(
            "%s: its file system has no locks; see that no other process works there", folder
        )
        return
    _held[folder.resolve()] = lock
    since = datetime.now().astimezone().isoformat(" ", "seconds")
    owner.write_text(f"pid {os.getpid()} on {socket.gethostname()}, since {since}")


def release_folder(folder: Path) -> None:
    """End this process' lock of a folder, if it has one."""
    lock = _held.pop(folder.resolve(), None)
    if lock is not None:
        (folder / PLACE / OWNER).unlink(missing_ok=True)
        lock.release()
