"""Files that are written whole or not at all, their folders, and the room on the disk."""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import yaml

from devrf.errors import DevrfError

# Bytes; the longest records, of footage of two hours, have some ten million. In memory each may
# become 50.
LARGEST_RECORD = 2**24
# Lists, objects, and their values but the first, of JSON; each may take 150 bytes and more. 50,000
# images with a pose and a lens each have two million.
MOST_VALUES = 2**22
# What JSON may have before its first value.
BLANK = b"\xef\xbb\xbf \t\r\n"
# Bytes of a YAML file, for which Python takes seconds.
LARGEST_YAML = 200_000
# Errors of values in a file that are not as devrf writes them.
UNREADABLE = (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError)
# Folders in one another, at most: Python's recursion ends at some hundreds.
DEEPEST = 64
# How the name of what is not whole yet begins.
PARTIAL = ".partial-"
# Errors of a disk, its permissions, or a path that was given. A missing file may be a fault of the
# program instead.
REFUSED = {
    *(errno.EACCES, errno.EPERM, errno.EROFS),
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO),
    *(errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP),
}


def utf8_path(path: Path) -> Path:
    """``path`` itself; DevrfError if a name in it is not UTF-8 text.

    Linux takes any bytes for a name. Records in JSON cannot hold them, and libraries that are given
    them end the program.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        escaped = os.fsencode(path).decode(errors="backslashreplace")
        raise DevrfError(f"{escaped}: its name is not UTF-8 text; rename it") from None
    return path


def refuse_links(folder: Path, *, itself: bool = False) -> None:
    """Raise a DevrfError if files that are written to a folder would go elsewhere.

    No link or pipe may be at its top; links in the folders there may lead to files below it, as
    wandb's do. Files in ``checkpoints``, and further down, are replaced by name. The folder may be
    a link, unless ``itself``, or lie below one; it need not exist yet.
    """
    whole = os.path.realpath(folder)
    top = [*os.scandir(folder)] if folder.is_dir() else []
    folders = [p for p in top if p.is_dir(follow_symlinks=False) and p.name != "checkpoints"]
    refused = [str(folder)] if itself and folder.is_symlink() else []
    for entry in [*top, *(entry for below in folders for entry in os.scandir(below))]:
        real = entry.is_file(follow_symlinks=False) or entry.is_dir(follow_symlinks=False)
        inside = entry.is_symlink() and os.path.realpath(entry).startswith(whole + os.sep)
        if not real and not (inside and entry not in top):
            refused.append(entry.path)
    if refused:
        raise DevrfError(f"{refused[0]}: a link or a pipe; remove it: devrf writes there")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A path to write to that becomes ``path`` when the block ends well, and vanishes otherwise.

    The folder is made. After a kill or a power failure at any moment the earlier file or the new
    one is there, whole.

    Raises:
        OSError: naming ``path``: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays last: writers choose the format by it.
    partial = path.with_name(PARTIAL + path.name)
    partial.unlink(missing_ok=True)  # it may be a link
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
        _sync_folder(path.parent)
    except OSError as error:
        if error.errno is None or str(error.filename or partial) != str(partial):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """A new folder that takes the place of ``folder`` when the block ends well, else vanishes.

    Raises:
        OSError: it cannot be written.
    """
    partial = folder.with_name(PARTIAL + folder.name)
    shutil.rmtree(partial, ignore_errors=True)  # of a killed process
    partial.mkdir(parents=True)
    try:
        yield partial
        shutil.rmtree(folder, ignore_errors=True)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _sync_folder(folder: Path) -> None:
    """Write a new name in ``folder`` to the disk, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8."""
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write ``values`` as an indented JSON object."""
    write_text(path, json.dumps(values, indent=2) + "\n")


def read_record(path: Path, most: int = LARGEST_RECORD) -> bytes:
    """The content of a file of JSON, CSV or YAML.

    Raises:
        ValueError: it is a pipe, or larger or of more values than what devrf writes, or a scene
            needs.
    """
    if path.exists() and not path.is_file():
        raise ValueError("not a regular file")  # a pipe would be waited for
    with path.open("rb") as file:
        return bounded(file.read(most + 1), most)


def bounded(content: bytes, most: int = LARGEST_RECORD) -> bytes:
    """``content`` that came as a record; ValueError if it is too large, or of too many values."""
    if len(content) > most:
        raise ValueError(f"larger than {most / 2**20:.3g} MiB")
    is_json = content.lstrip(BLANK)[:1] in (b"[", b"{")
    if is_json and sum(map(content.count, b"[{,")) > MOST_VALUES:
        raise ValueError(f"more than {MOST_VALUES:,} values")
    return content


class _PlainLoader(yaml.SafeLoader):  # type: ignore[misc]
    """Plain values, OpenCV's matrices as mappings; no aliases, which unfold without end."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)


_PlainLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", yaml.SafeLoader.construct_yaml_map)


def read_yaml(path: Path) -> Any:
    """The plain values in a YAML file.

    Raises:
        YAMLError | ValueError | RecursionError: it is damaged, too large or too deep.
    """
    text = read_record(path, LARGEST_YAML).decode()
    return yaml.load(text.removeprefix("%YAML:1.0"), _PlainLoader)  # OpenCV's first line is no YAML


def walk(folder: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """As :func:`os.walk`, in order of names, without hidden folders and any deeper than DEEPEST."""
    for walked, inner, names in os.walk(folder):
        path = Path(walked)
        deepest = len(path.parts) - len(folder.parts) >= DEEPEST
        inner[:] = [] if deepest else sorted(name for name in inner if name[0] != ".")
        yield path, inner, names


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder and what is in it; none need be there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def free_disk(folder: Path) -> int:
    """Bytes that can be written to ``folder``, which need not exist yet."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(existing).free


def holds_at_most(folder: Path, names: set[str]) -> bool:
    """Whether nothing is in ``folder`` but ``names``."""
    return folder.is_dir() and {path.name for path in folder.iterdir()} <= names


def remove_if_only(folder: Path, names: set[str]) -> None:
    """Remove ``folder`` if it holds nothing but ``names``, and then empty parents.

    The working folder and all above it stay; so do the parents of a folder elsewhere.
    """
    if not holds_at_most(folder, names):
        return
    close_logs()
    for name in names:
        remove(folder / name)
    working_folder, folder = Path.cwd(), folder.resolve()
    if working_folder.is_relative_to(folder):
        return
    with suppress(OSError):  # the first that is not empty
        for path in [folder, *(path for path in folder.parents if working_folder in path.parents)]:
            path.rmdir()


def close_logs() -> None:
    """Close the log files; one that is written to again is opened anew."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.FileHandler):
            handler.close()
