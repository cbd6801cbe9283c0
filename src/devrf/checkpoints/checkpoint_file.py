"""Files that vouch for themselves: written whole or not at all, every altered byte noticed.

A sealed file is an archive of ``torch.save`` with a seal of 52 bytes behind it: a mark, the
format's version, the archive's length, and a SHA-256 over all of these. The seal is inside the
file, so that no copy loses it; ``torch.load`` and unzip do not mind it.

It is written beside its place under another name, reaches the disk, and only then takes its
name: whenever the power goes or the process is killed, the file of before or the new one is
there, whole. When it is read, nothing is believed before the seal has been checked, no code is
run (``weights_only``), and nothing may claim more memory than the file has bytes.
"""

from __future__ import annotations

import hashlib
import os
import pickletools
import re
import struct
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from devrf.errors import DevrfError

FORMAT = 2
MARK = b"\x89devrf\r\n"
SEAL = struct.Struct("<8sIQ32s")  # mark, format, length of the archive, digest
HEAD = struct.Struct("<8sIQ")

# Bytes of the pickle that describes the tensors, and objects in it: far more than any run has.
LONGEST_DESCRIPTION = 2**20
MOST_OBJECTS = 100_000
# All that the pickle may call, beside types of storage.
CALLED = {"torch._utils _rebuild_tensor_v2", "collections OrderedDict"}


def write_checkpoint_file(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` to ``path``; a file that was there stays until the new one is safe.

    Args:
        path: the file; its folder is made.
        content: tensors and plain data.

    Raises:
        OSError: naming ``path``; nothing of the attempt is left.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    try:
        with partial.open("wb") as file:
            sealing = _Sealing(file)
            torch.save(content, sealing)  # type: ignore[arg-type]  # write and flush are enough
            file.write(sealing.seal())
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
        _reach_disk(path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        partial.unlink(missing_ok=True)


def _reach_disk(folder: Path) -> None:
    """Make a new name in a folder last; not every system can."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


class _Sealing:
    """A file for ``torch.save`` to write to, hashed on the way.

    An error must not unwind through torch's writer, which would end the process: it is kept,
    and raised when the seal is asked for.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._digest = hashlib.sha256()
        self._length = 0
        self._failure: BaseException | None = None

    def write(self, data: Any) -> int:
        """Write and hash ``data``, a bytes-like object."""
        count = memoryview(data).nbytes
        if self._failure is None:
            try:
                self._file.write(data)
                self._digest.update(data)
                self._length += count
            except BaseException as failure:
                self._failure = failure
        return count

    def flush(self) -> None:
        """Nothing: the file is flushed once, when it is whole."""

    def seal(self) -> bytes:
        """The seal of all that was written.

        Raises:
            BaseException: what has gone wrong while writing.
        """
        if self._failure is not None:
            raise self._failure
        head = HEAD.pack(MARK, FORMAT, self._length)
        self._digest.update(head)
        return head + self._digest.digest()


def digest_of(path: Path) -> str:
    """The digest in a file's seal, in hexadecimal: which content it is; "" without a seal."""
    with path.open("rb") as file:
        found = _seal(file)
    return found[3].hex() if found else ""


def read_checkpoint_file(path: Path) -> dict[str, Any]:
    """The content of a sealed file, on the host.

    Raises:
        DevrfError: the file is truncated, altered, of a newer format, or not devrf's.
    """
    _check_seal(path)
    try:
        _check_archive(path)
        content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        _check_claims(content)
    except Exception:  # noise in a file makes the unpickler raise whatever it likes
        raise DevrfError(
            f"{path}: sealed, but its content is not devrf's; set ckpt to a file that devrf wrote"
        ) from None
    return content


def _seal(file: BinaryIO) -> tuple[bytes, int, int, bytes] | None:
    size = file.seek(0, os.SEEK_END)
    if size < SEAL.size:
        return None
    file.seek(size - SEAL.size)
    mark, version, length, digest = SEAL.unpack(file.read(SEAL.size))
    return (mark, version, length, digest) if mark == MARK else None


def _check_seal(path: Path) -> None:
    """Check that a file is as it was written, and of a format that is known here."""
    with path.open("rb") as file:
        found = _seal(file)
        if found is None:
            raise DevrfError(f"{path}: {_unsealed(file)}")
        mark, version, length, digest = found
        file.seek(0)
        actual, left = hashlib.sha256(), file.seek(0, os.SEEK_END) - SEAL.size
        if left != length:
            raise DevrfError(
                f"{path}: damaged: {left} bytes where {length} were written; take a copy that is "
                "whole, or train again"
            )
        file.seek(0)
        while left:
            piece = file.read(min(left, 2**22))
            actual.update(piece)
            left -= len(piece)
        actual.update(HEAD.pack(mark, version, length))
    if actual.digest() != digest:
        raise DevrfError(
            f"{path}: damaged: altered since it was written (its checksum does not match); take "
            "a copy that is whole, or train again"
        )
    if version != FORMAT:
        age = "newer" if version > FORMAT else "older"
        raise DevrfError(
            f"{path}: has format {version}, {age} than the {FORMAT} that this version reads; use "
            "the version of devrf that wrote it, or train again"
        )


def _unsealed(file: BinaryIO) -> str:
    """What is wrong with a file that does not end in a seal."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if size and file.read(4) != b"PK\x03\x04":
        return "not a checkpoint; expected a file that devrf wrote"
    file.seek(max(0, size - 2**16))
    _, end, behind = file.read().rpartition(b"PK\x05\x06")
    # An archive ends 22 bytes from its last mark; more than that was the beginning of a seal.
    if end and len(behind) == 18:
        return "not a devrf checkpoint: it has no seal; expected a file that devrf wrote"
    return "damaged: truncated; take a copy that is whole, or train again"


def _check_archive(path: Path) -> None:
    """Refuse records that unfold to more than the file has, and a pickle that calls anything."""
    with zipfile.ZipFile(path) as archive:
        records = archive.infolist()
        if any(record.compress_type != zipfile.ZIP_STORED for record in records):
            raise ValueError("compressed")
        if sum(record.file_size for record in records) > path.stat().st_size:
            raise ValueError("records that overlap")
        (described,) = (r for r in records if r.filename.endswith("data.pkl"))
        if described.file_size > LONGEST_DESCRIPTION:
            raise ValueError("an endless description")
        pickle = archive.read(described)
    for operation, argument, _ in pickletools.genops(pickle):
        if "GLOBAL" in operation.name or operation.name == "INST":
            storage = re.fullmatch(r"torch \w+Storage", str(argument))
            if storage is None and argument not in CALLED:
                raise ValueError(f"calls {argument}")


def _check_claims(content: object) -> None:
    """Refuse tensors that are larger than the memory behind them, and endless structures."""
    waiting, met = [content], 0
    while waiting:
        one = waiting.pop()
        met += 1
        if isinstance(one, Tensor):
            dense = one.layout == torch.strided and one.device.type == "cpu"
            if not dense or one.numel() * one.element_size() > one.untyped_storage().nbytes():
                raise ValueError("a tensor that is larger than its memory")
        elif isinstance(one, dict | list | tuple | set):
            if met + len(waiting) + len(one) > MOST_OBJECTS:
                raise ValueError("endless")
            waiting += [*one, *one.values()] if isinstance(one, dict) else one
