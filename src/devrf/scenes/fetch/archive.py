"""The folder of one scene out of a zip or tar archive."""

from __future__ import annotations

import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

from devrf.errors import DevrfError
from devrf.system.files import free_disk

# What a Mac adds to archives.
FOREIGN = "__MACOSX"
DAMAGED = (zipfile.BadZipFile, tarfile.TarError, EOFError, zlib.error, NotImplementedError)


@dataclass(frozen=True)
class Member:
    """An ordinary file of an archive: links and devices are left out.

    Attributes:
        path: as the archive names it.
        size: in bytes, unpacked.
        open: gives its content.
    """

    path: PurePosixPath
    size: int
    open: Callable[[], IO[bytes]]


def unpack_scene(archive: Path, marker: str, folder: str | None, into: Path) -> None:
    """Unpack the folder that holds the file ``marker``, without the folders around it.

    Args:
        archive: zip, or tar with any compression.
        marker: name of a file that only a scene's folder has.
        folder: name of the folder, where the archive has several; None: it has one.
        into: the new folder.

    Raises:
        DevrfError: the archive is damaged, has no such folder, or does not fit on the disk.
    """
    try:
        with _members(archive) as members:
            root = _scene_folder(archive, members, marker, folder)
            _unpack([one for one in members if root in one.path.parents], root, into)
    except DAMAGED as error:
        raise DevrfError(
            f"{archive}: cannot be unpacked ({error or type(error).__name__}); remove it, and the "
            "same command fetches it again"
        ) from None


@contextmanager
def _members(archive: Path) -> Iterator[list[Member]]:
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as file:
            yield [
                Member(PurePosixPath(one.filename), one.file_size, _opener(file.open, one))
                for one in file.infolist()
                if not one.is_dir()
            ]
    else:
        with tarfile.open(archive) as tar:
            yield [
                Member(PurePosixPath(one.name), one.size, _opener(tar.extractfile, one))
                for one in tar.getmembers()
                if one.isreg()
            ]


def _opener(read: Callable[[Any], Any], member: object) -> Callable[[], IO[bytes]]:
    return lambda: read(member)


def _scene_folder(
    archive: Path, members: list[Member], marker: str, folder: str | None
) -> PurePosixPath:
    found = {
        one.path.parent
        for one in members
        if one.path.name == marker
        and FOREIGN not in one.path.parts
        and folder in (None, one.path.parent.name)
    }
    if not found:
        raise DevrfError(
            f"{archive}: holds no {folder or 'folder'} with {marker}; what is published has "
            "changed: unpack it by hand"
        )
    return min(found, key=lambda path: (len(path.parts), path))


def _unpack(members: list[Member], root: PurePosixPath, into: Path) -> None:
    needed, there = sum(one.size for one in members), free_disk(into)
    if needed > there:
        raise DevrfError(
            f"fetch.into: {needed / 1e6:.0f} MB to unpack, but {there / 1e6:.0f} MB are free; "
            "free some, or give fetch.into=PATH on another disk"
        )
    for one in members:
        within = one.path.relative_to(root)
        if ".." in within.parts:
            raise DevrfError(f"fetch.into: the archive would write {one.path} outside its folder")
        path = into / within
        path.parent.mkdir(parents=True, exist_ok=True)
        with one.open() as source, path.open("wb") as target:
            shutil.copyfileobj(source, target)
