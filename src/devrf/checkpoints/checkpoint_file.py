"""Checkpoint files: safetensors with a checksum, written whole or not at all.

A safetensors file whose metadata hold the rest of the nested data as JSON, behind a seal: the
format's number, the bytes of tensor data, and a SHA-256 of all bytes of the file but its own
digits. So every altered byte is noticed, and no code is ever run.

The library reads once the checksum is right. It does not write: ``safetensors.save_file`` needs all
tensors on the host at once, leaves a file of a random name when it is killed, and raises no OSError
when the disk is full.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from devrf.checkpoints.nested import flatten, unflatten
from devrf.errors import DevrfError
from devrf.system.files import atomic_write

FORMAT = 3
# How the JSON header begins; eight bytes before it give its length.
SEAL = re.compile(
    rb'\{"__metadata__": \{"devrf": "(\d+)", "bytes": "(\d+)", "sha256": "([0-9a-f]{64})", '
)
UNKNOWN = "0" * 64  # in the digest's place until it is known
# Bytes of the header: far more than any run writes, far less than memory holds.
LONGEST_HEADER = 2**24
# Format 2, an archive of torch.save, ended in 52 bytes that begin so.
END_OF_2 = b"\x89devrf\r\n\x02"
# The names of safetensors.
DTYPES = {getattr(torch, f"float{bits}"): f"F{bits}" for bits in (16, 32, 64)}
DTYPES |= {getattr(torch, f"int{bits}"): f"I{bits}" for bits in (8, 16, 32, 64)}
DTYPES |= {torch.bfloat16: "BF16", torch.uint8: "U8", torch.bool: "BOOL"}


class OtherFormatError(DevrfError):
    """A whole file of a format that this version does not read."""

    def __init__(self, path: Path, version: int) -> None:
        age = "newer" if version > FORMAT else "older"
        super().__init__(
            f"{path}: has format {version}, {age} than the {FORMAT} that this version reads; use "
            "the version of devrf that wrote it, or train again"
        )


class _Seal(NamedTuple):
    """The beginning of a file: format, bytes in all, SHA-256, and where its digits are."""

    version: int
    size: int
    digest: str
    place: int


def write_checkpoint_file(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` to ``path``; a file that was there stays until the new one is whole.

    Args:
        path: the file; its folder is made.
        content: nested dicts, lists, tuples and sets of tensors, numbers, strings and None.

    Raises:
        OSError: naming ``path``; nothing of the attempt is left.
        TypeError, KeyError: a value, or the dtype of a tensor, cannot be stored.
    """
    tensors: dict[str, Tensor] = {}
    nested = json.dumps(flatten(content, tensors))
    total, entries = 0, {}
    # The widest elements first, so that all stand at multiples of their width.
    for name in sorted(tensors, key=lambda name: -tensors[name].element_size()):
        tensor, begin, total = tensors[name], total, total + tensors[name].nbytes
        shape, dtype = list(tensor.shape), DTYPES[tensor.dtype]
        entries[name] = {"dtype": dtype, "shape": shape, "data_offsets": [begin, total]}
    seal = {"devrf": str(FORMAT), "bytes": str(total), "sha256": UNKNOWN, "nested": nested}
    header = json.dumps({"__metadata__": seal, **entries}).encode()
    header += b" " * (-len(header) % 8)
    start = len(header).to_bytes(8, "little") + header
    place = start.index(UNKNOWN.encode())
    digest = hashlib.sha256(start[:place] + start[place + len(UNKNOWN) :])
    with atomic_write(path) as partial, partial.open("wb") as file:
        file.write(start)
        for name in entries:
            data = _data(tensors[name])
            file.write(data)
            digest.update(data)
        file.seek(place)
        file.write(digest.hexdigest().encode())


def read_checkpoint_file(path: Path) -> dict[str, Any]:
    """The content of a checkpoint file, on the host.

    Raises:
        DevrfError: the file is truncated, altered, of another format, or not devrf's.
    """
    _check(path)
    try:
        with safe_open(path, "pt") as file:
            nested, names = json.loads(file.metadata()["nested"]), file.keys()
        content = unflatten(nested, {name: _tensor(path, name) for name in names})
    except (SafetensorError, LookupError, RecursionError, TypeError, ValueError):
        content = None
    if not isinstance(content, dict):
        raise DevrfError(
            f"{path}: whole, but its content is not devrf's; set ckpt to a file that devrf wrote"
        )
    return content


def read_description(path: Path) -> dict[str, Any]:
    """The content of a checkpoint file with None for each tensor; only its header is read.

    Altered bytes are not noticed: what is used further is read by :func:`read_checkpoint_file`.

    Raises:
        DevrfError: the file does not begin as devrf's of this format.
    """
    with path.open("rb") as file:
        seal = _seal(file)
        file.seek(0)
        header = file.read(int.from_bytes(file.read(8), "little")) if seal else b""
    if seal is not None and seal.version != FORMAT:
        raise OtherFormatError(path, seal.version)
    try:
        nested = json.loads(json.loads(header)["__metadata__"]["nested"])
        content = unflatten(nested, defaultdict(lambda: None))
    except (LookupError, RecursionError, TypeError, ValueError):
        content = None
    if not isinstance(content, dict):
        raise DevrfError(f"{path}: not a devrf checkpoint, or a damaged one")
    return content


def digest_of(path: Path) -> str:
    """The SHA-256 in a file's seal, in hexadecimal: which content it is; "" without a seal."""
    with path.open("rb") as file:
        seal = _seal(file)
    return seal.digest if seal else ""


def _data(tensor: Tensor) -> memoryview:
    """A tensor's elements as bytes on the host."""
    return tensor.cpu().contiguous().view(-1).view(torch.uint8).numpy().data


def _tensor(path: Path, name: str) -> Tensor:
    """A copy of a tensor of a file, which the library maps into memory.

    The file is opened anew for each: what is mapped counts as memory until it is closed.
    """
    with safe_open(path, "pt") as file:
        tensor: Tensor = file.get_tensor(name)
        return tensor.clone()


def _seal(file: BinaryIO) -> _Seal | None:
    """The seal at the beginning of a file; None if there is none."""
    length = int.from_bytes(file.read(8), "little")
    found = SEAL.match(file.read(256))
    if found is None or length > LONGEST_HEADER:
        return None
    version, count, digest = found.groups()
    return _Seal(int(version), 8 + length + int(count), digest.decode(), 8 + found.start(3))


def _check(path: Path) -> None:
    """Raise a DevrfError unless a file is as it was written, and of the present format."""
    with path.open("rb") as file:
        seal, size = _seal(file), path.stat().st_size
        if seal is None:
            file.seek(max(0, size - 52))
            if file.read(len(END_OF_2)) == END_OF_2:
                raise OtherFormatError(path, 2)
            raise DevrfError(
                f"{path}: not a devrf checkpoint, or only the first bytes of one; expected a file "
                "that devrf wrote"
            )
        damage = "altered since it was written (its checksum does not match)"
        if size != seal.size:
            damage = "truncated" if size < seal.size else "altered"
            damage += f", {size} bytes where {seal.size} were written"
        file.seek(0)
        actual = hashlib.sha256(file.read(seal.place))
        file.seek(seal.place + len(UNKNOWN))
        while piece := file.read(2**22):
            actual.update(piece)
    if actual.hexdigest() != seal.digest:
        raise DevrfError(f"{path}: damaged: {damage}; take a copy that is whole, or train again")
    if seal.version != FORMAT:
        raise OtherFormatError(path, seal.version)
