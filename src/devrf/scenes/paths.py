"""Paths of a scene: what is there, what can be read, and where text in a file may lead."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from devrf.scenes.validation import abbreviated, scene_error


def scene_folder(root: str | Path) -> Path:
    """The folder that the user calls ``root``, with ``~`` filled in; else DevrfError."""
    try:
        return existing_folder(Path(root).expanduser())
    except RuntimeError as error:  # there is no user of that name
        raise scene_error(
            "data.root", f"{abbreviated(str(root))} is not a path ({error})"
        ) from None


def existing_folder(folder: Path) -> Path:
    """``folder`` itself, or DevrfError when there is no such folder."""
    if not os.path.isdir(folder):  # unlike Path.is_dir it raises on nothing
        raise scene_error(folder, "no such folder; set data.root to the scene's folder")
    return folder


def existing_file(file: Path, purpose: str) -> int:
    """The size of ``file`` in bytes.

    Args:
        file: where an ordinary file should be, or a link to one.
        purpose: what it is needed for, for the message.

    Raises:
        DevrfError: there is none, or it may not be looked at.
    """
    try:
        status = os.stat(file)
    except (FileNotFoundError, NotADirectoryError):
        raise scene_error(file, f"no such file; {purpose}") from None
    except OSError as error:
        raise scene_error(file, f"cannot be read ({error.strerror}); {purpose}") from None
    # A pipe or a device could keep its reader waiting for ever.
    if not stat.S_ISREG(status.st_mode):
        raise scene_error(file, f"no such file, but something else of that name; {purpose}")
    return status.st_size


def entries(folder: Path) -> list[Path]:
    """What lies in ``folder``, in order of names; DevrfError when that may not be known."""
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise scene_error(
            folder, f"cannot be listed ({error.strerror}); correct its permissions"
        ) from None


def inside(root: Path, folder: Path, name: str, file: Path) -> Path:
    """Where ``name``, text in a file, leads: somewhere below ``root``.

    Text cannot leave the scene's folder: ``..`` is taken out of the text itself, whatever the
    folders that it names may be links to. Links that lie in the scene's folder are followed,
    since only its owner can have put them there, and scenes are often put together from them.

    Args:
        root: the scene's folder.
        folder: the folder, ``root`` or below, that the name is relative to.
        name: the text.
        file: the file that it came from, for the message.

    Returns:
        A path that starts with ``root``; whether there is such a file is not looked up.

    Raises:
        DevrfError: the name leads outside, or no file can have it.
    """
    try:
        encoded = os.fsencode(name)
    except UnicodeEncodeError:
        encoded = b"\0"
    if b"\0" in encoded:
        raise scene_error(file, f"{abbreviated(name)} is not a path; correct it")
    inner = (
        os.path.relpath(name, root)
        if os.path.isabs(name)
        else os.path.normpath(folder.relative_to(root) / name)
    )
    if inner == os.curdir or inner.split(os.sep)[0] == os.pardir:
        raise scene_error(
            file,
            f"{abbreviated(name)} leads outside the scene's folder {root}; put the file into it",
        )
    return root / inner
