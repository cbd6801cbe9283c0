"""Files of a scene: paths that stay inside its folder, JSON, arrays; one clear line on failure."""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, Field, ValidationError

from devrf.errors import DevrfError
from devrf.scenes.validation import LARGEST, scene_error
from devrf.system.files import read_record, utf8_path
from devrf.system.options import abbreviated, first_error
from devrf.system.override import to_type
from devrf.system.printed import is_shown

Numbers = npt.NDArray[np.float64]

# A number that float32 holds: no text, no truth value, neither NaN nor infinity.
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=-LARGEST, lt=LARGEST)]
Positive = Annotated[Number, Field(gt=0)]
Vector2 = tuple[Number, Number]
Vector3 = tuple[Number, Number, Number]
Vector4 = tuple[Number, Number, Number, Number]
Name = Annotated[str, Field(min_length=1)]


def _distinct(ids: list[str]) -> list[str]:
    if len(set(ids)) < len(ids):
        raise ValueError("expected a list of distinct ids; correct it")
    return ids


# Images that a file may list: each takes a tenth of a millisecond to be found, or not.
MOST_IMAGES = 50_000
LARGEST_ROW = 17  # numbers of a camera in an array
Ids = Annotated[
    list[Name], Field(fail_fast=True, max_length=MOST_IMAGES), AfterValidator(_distinct)
]

Content = TypeVar("Content", bound=BaseModel)

# Letters of a path, and folders of another machine's that are looked for here, at most.
LONGEST_PATH = 4096
MOST_FOLDERS = 32


@contextmanager
def decoding(path: Path, what: str, remedy: str) -> Iterator[None]:
    """Turn the errors of a library that decodes ``path`` into a DevrfError.

    ``what`` names the expected kind of file, ``remedy`` the way to get one.
    """
    try:
        yield
    except DevrfError:
        raise
    # Any exception: the type depends on the format and the damage.
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise scene_error(
            path, f"not a readable {what} ({reason}); {_stands_in(path) or remedy}"
        ) from None


def _stands_in(path: Path) -> str:
    """The remedy if a file is a mere placeholder of the one of its name; else empty."""
    try:
        with path.open("rb") as stream:
            start = stream.read(64).lower()
    except OSError:
        return ""
    if start.startswith(b"version https://git-lfs"):
        return "it is a Git LFS pointer: run git lfs pull"
    if start.lstrip().startswith((b"<!doctype html", b"<html")):
        return "it is a web page: download the file again"
    return ""


ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")


def scene_folder(root: str | Path) -> Path:
    """The user's folder ``root``, with ``~`` filled in; else DevrfError.

    All records of a scene have its folder's name, so it has to be printable text.
    """
    try:
        folder = existing_folder(Path(root).expanduser())
    except RuntimeError as error:  # there is no user of that name
        raise scene_error("data.root", f"{root} is not a path ({error})") from None
    if not is_shown(str(utf8_path(folder.resolve()))):
        raise scene_error(abbreviated(str(folder)), "its name holds control characters; rename it")
    return folder


def existing_folder(folder: Path) -> Path:
    """``folder`` itself, or DevrfError if there is no such folder."""
    if os.path.isfile(folder):
        if folder.suffix.lower() in ARCHIVES:
            raise scene_error(folder, "is an archive; unpack it, and set data.root to its folder")
        parent = to_type("data.root", folder.parent)
        raise scene_error(folder, "is a file, expected the scene's folder; write", parent)
    if not os.path.isdir(folder):  # unlike Path.is_dir it raises on nothing
        raise scene_error(folder, "no such folder; set data.root to the scene's folder")
    return folder


def existing_file(file: Path, purpose: str) -> Path:
    """``file`` itself, or a DevrfError with its ``purpose`` if there is no such file."""
    if not os.path.isfile(file):
        raise scene_error(file, f"no such file; {purpose}")
    return file


def entries(folder: Path) -> list[Path]:
    """The entries of ``folder``, in order of names; DevrfError if they may not be listed."""
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise scene_error(
            folder, f"cannot be listed ({error.strerror}); correct its permissions"
        ) from None


def inside(root: Path, folder: Path, name: str, file: Path) -> Path:
    """The path below ``root`` that ``name``, text in ``file``, means from ``folder``.

    ``..`` is resolved in the text itself; links in the scene's folder are followed; back slashes
    separate folders, too. An absolute path of another machine means its longest tail whose folder
    exists here. The file need not exist. DevrfError if the name leads outside, or no file can have
    it.
    """
    if "\0" in name or len(name) > LONGEST_PATH:
        raise scene_error(file, f"{abbreviated(name)} is not a path; correct it")
    path = name.replace("\\", "/")
    if from_elsewhere(root, name):
        path = _tail(root, folder, os.path.normpath(path)) or path
    inner = (
        os.path.relpath(path, root)
        if os.path.isabs(path)
        else os.path.normpath(folder.relative_to(root) / path)
    )
    if inner == os.curdir or inner.split(os.sep)[0] == os.pardir or _DRIVE.match(path):
        raise scene_error(
            file,
            f"{abbreviated(name)} leads outside the scene's folder {root}; put the file into it",
        )
    return root / inner


_DRIVE = re.compile(r"[A-Za-z]:[/\\]")


def from_elsewhere(root: Path, name: str) -> bool:
    """Whether ``name`` is an absolute path, of any system, that does not lead below ``root``."""
    below = os.path.normpath(name).startswith(os.path.join(os.path.abspath(root), ""))
    return bool(_DRIVE.match(name)) or (name[:1] in ("/", "\\") and not below)


def _tail(root: Path, folder: Path, path: str) -> str | None:
    """Where the longest tail of an absolute path leads from ``folder``, or else from ``root``."""
    parts = PurePosixPath(path).parts[1:][-MOST_FOLDERS:]
    for above in (folder, root):
        for start in range(len(parts)):
            tail = above.joinpath(*parts[start:])
            exists = os.path.isdir(tail.parent) if start < len(parts) - 1 else os.path.isfile(tail)
            if exists:
                return os.path.relpath(tail, folder)
    return None


def read_json(file: Path, kind: type[Content], purpose: str) -> Content:
    """The content of a JSON file of one object; ``purpose`` is for the message if it is missing.

    DevrfError if there is no such file, it is no JSON, a key is missing or its value wrong.
    """
    try:
        # Some editors begin a file with a byte order mark.
        data = read_record(existing_file(file, purpose)).removeprefix(codecs.BOM_UTF8)
        return kind.model_validate_json(data)
    except OSError as error:
        raise scene_error(file, f"cannot be read ({error.strerror}); {purpose}") from None
    except ValidationError as error:
        if remedy := _stands_in(file):
            raise scene_error(file, f"not JSON; {remedy}") from None
        raise first_error(error, f"{file}: ") from None
    except ValueError as error:  # its size
        raise scene_error(file, f"{error}; write it again") from None


def read_numbers(path: Path, expected: str) -> Numbers:
    """The array in an ``.npy`` file, in double precision; ``expected`` describes it.

    DevrfError if there is no such file, it is damaged, or holds no numbers, or NaN or infinity.
    """
    existing_file(path, f"expected {expected}")
    with decoding(path, "npy file", "write it again"):
        # Mapped: an array that is larger than its file is refused before it takes memory.
        values: npt.NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
        if values.size > LARGEST_ROW * MOST_IMAGES:
            raise ValueError("more than the cameras of a capture")
    if values.dtype.kind not in "fiu":
        raise scene_error(path, f"holds values of type {values.dtype}, expected {expected}")
    # NaN compares false.
    if not bool((values < LARGEST).all() and (values > -LARGEST).all()):
        raise scene_error(path, "holds NaN or infinity; write it again from valid camera poses")
    return values.astype(np.float64)
