"""Arrays in ``.npy`` and ``.npz`` files: nothing is executed, and nothing unpacked unexpected.

``np.load`` makes room for all that a header claims and unpacks all that an archive holds. So a
header is compared with the file, or with what the images explain, before its array is read.
Pickled objects are never loaded.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from devrf.scenes.decoding import decoding
from devrf.scenes.paths import existing_file
from devrf.scenes.validation import LARGEST, scene_error

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
