"""Files of a scene: paths that stay inside its folder, JSON, arrays; one clear line on failure."""

from __future__ import annotations

import codecs
import math
import os
import stat
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from devrf.errors import DevrfError
from devrf.scenes.validation import LARGEST, abbreviated, first_error, scene_error


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


# Some 60,000 posed images with every number on a line of its own.
MAX_BYTES = 64 * 2**20
# As many images without white space. A parser takes up to 300 bytes for each value and key.
MAX_VALUES = 4_000_000
_BEFORE_VALUES = b"[{,:"

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


Ids = Annotated[list[Name], Field(fail_fast=True), AfterValidator(_distinct)]

Content = TypeVar("Content")


def read_json(file: Path, kind: TypeAdapter[Content], purpose: str) -> Content:
    """The content of a JSON file; of a key that is there twice, the last one counts.

    Args:
        file: a file that holds one object.
        kind: what the object must be.
        purpose: what the file is needed for, for the message when it is missing.

    Raises:
        DevrfError: there is no such file, it is no JSON, a key is missing or its value wrong, or
            the file is so large that it cannot be a list of images.
    """
    if existing_file(file, purpose) > MAX_BYTES:
        raise scene_error(
            file,
            f"larger than {MAX_BYTES >> 20} MiB, expected a list of posed images; write it again",
        )
    try:
        data = file.read_bytes()
    except OSError as error:
        raise scene_error(file, f"cannot be read ({error.strerror}); {purpose}") from None
    # Counted before they are made: two bytes of text can become hundreds of memory.
    if sum(data.count(byte) for byte in _BEFORE_VALUES) > MAX_VALUES:
        raise scene_error(
            file,
            f"holds more than {MAX_VALUES // 10**6} million values, expected a list of "
            "posed images; write it again",
        )
    try:
        # Some editors begin a file with a byte order mark.
        return kind.validate_json(data.removeprefix(codecs.BOM_UTF8))
    except ValidationError as error:
        raise first_error(error, f"{file}: ") from None


Numbers = npt.NDArray[np.float64]

# Camera files: a quarter of a million cameras of 17 numbers; 32 MiB in double precision.
MOST_NUMBERS = 2**22
# Archives may hold other arrays too, but not so many that their mere list fills the memory:
# two and a half times the vectors and masks in double precision.
BYTES_PER_VALUE = 20
SMALL_ARCHIVE = 2**20
# A long double has 16 bytes; the longest text that is kept has 64 characters of 4.
_WIDEST = 256
_PLAIN = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Later versions are for headers of more than 65535 bytes: no plain array has one.
_VERSION = (1, 0)


@dataclass(frozen=True)
class Form:
    """What an array is, or should be.

    Attributes:
        shape: its lengths.
        kinds: the letters of the kinds of values that it may hold, as in ``numpy.dtype.kind``.
    """

    shape: tuple[int, ...]
    kinds: str = "fiu"


def read_numbers(path: Path, expected: str) -> Numbers:
    """The array in ``path``, in double precision.

    Args:
        path: an ``.npy`` file.
        expected: what it should hold, in words, for the message.

    Raises:
        DevrfError: there is no such file, it is damaged, holds no numbers or far too many of
            them, or NaN or infinity.
    """
    size = existing_file(path, f"expected {expected}")
    with decoding(path, "npy file", "write it again"), path.open("rb") as stream:
        shape, dtype = _header(stream)
        count = math.prod(shape)
        if dtype.kind not in "fiu":
            raise scene_error(path, f"holds values of type {dtype}, expected {expected}")
        if stream.tell() + count * dtype.itemsize > size:
            raise ValueError(f"{shape} values of type {dtype} do not fit into {size} bytes")
        if count > MOST_NUMBERS:
            raise scene_error(path, f"has shape {shape}, which is too large; expected {expected}")
        stream.seek(0)
        values = np.lib.format.read_array(stream, allow_pickle=False)
    # NaN compares false.
    if not bool((values < LARGEST).all() and (values > -LARGEST).all()):
        raise scene_error(path, "holds NaN or infinity; write it again from valid camera poses")
    return values.astype(np.float64)


def read_archive(
    path: Path, forms: Mapping[str, Form], explained_by: str, remedy: str
) -> dict[str, npt.NDArray[Any]]:
    """Arrays of an ``.npz``, each of a known form; what else it holds is left alone.

    Args:
        path: an existing file.
        forms: the arrays that are wanted.
        explained_by: what says that they have these shapes, in words, for the message.
        remedy: what to do about a wrong file, for the message.

    Raises:
        DevrfError: the file is damaged, or an array is missing or of another form.
    """
    most = SMALL_ARCHIVE + BYTES_PER_VALUE * sum(math.prod(f.shape) for f in forms.values())
    if existing_file(path, remedy) > most:
        raise scene_error(path, f"larger than {most >> 20} MiB, which {explained_by}; {remedy}")
    with decoding(path, "npz", remedy), zipfile.ZipFile(path) as archive:
        return {
            name: _member(archive, name, form, path, explained_by, remedy)
            for name, form in forms.items()
        }


def _member(
    archive: zipfile.ZipFile, name: str, form: Form, path: Path, explained_by: str, remedy: str
) -> npt.NDArray[Any]:
    found = [info for info in archive.infolist() if info.filename == f"{name}.npy"]
    if len(found) != 1:
        has = "has no" if not found else "has more than one"
        raise scene_error(path, f'{has} array "{name}"; {remedy}')
    if found[0].compress_type not in _PLAIN:
        raise ValueError(f'"{name}" is compressed in a way that numpy does not write')
    with archive.open(found[0]) as member:
        shape, dtype = _header(member)
    if shape != form.shape:
        raise scene_error(
            path, f'"{name}" has shape {shape}, expected {form.shape} as {explained_by}; {remedy}'
        )
    if dtype.kind not in form.kinds:
        raise scene_error(path, f'"{name}" holds values of type {dtype}; {remedy}')
    with archive.open(found[0]) as member:
        values: npt.NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)
        if member.read(1):
            raise ValueError(f'"{name}" goes on after its end')
    return values


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type that an npy claims; the stream is left at its first value.

    Raises:
        ValueError: and others, from numpy, when it is damaged or holds pickled objects.
    """
    version = np.lib.format.read_magic(stream)
    if version != _VERSION:
        raise ValueError(f"format version {version}, which numpy writes for no plain numbers")
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject:
        raise ValueError("pickled objects, which are never loaded")
    if min(shape, default=0) < 0 or dtype.itemsize > _WIDEST:
        raise ValueError(f"values of type {dtype} in the shape {shape}")
    return shape, dtype


@contextmanager
def decoding(path: Path, what: str, remedy: str) -> Iterator[None]:
    """The place where a library decodes ``path``: what it raises becomes a DevrfError.

    Nothing else belongs into its block.

    Args:
        path: the file.
        what: what the file should be, in words.
        remedy: what to do when it is not.
    """
    try:
        yield
    except DevrfError:
        raise
    # Any exception: what decoders raise depends on the format and the damage.
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise scene_error(path, f"not a readable {what} ({reason}); {remedy}") from None
