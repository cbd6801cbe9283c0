"""Checkpoint files: safetensors with a checksum, written whole or not at all.

The metadata of a safetensors file hold the number of the format, the rest of the nested data as
JSON, and a SHA-256 of that and of the tensors. So damage is noticed, and no code is ever run.

``safetensors.save_file`` is not used for writing: it copies all tensors to the host at once, and
raises no OSError when the disk is full.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from devrf.checkpoints.file_metadata import FORMAT, file_metadata
from devrf.errors import DevrfError
from devrf.system.files import UNREADABLE, atomic_write
from devrf.system.memory import need_memory

UNKNOWN = "0" * 64  # in the digest's place until it is known
# The names of safetensors.
DTYPES = {getattr(torch, f"float{bits}"): f"F{bits}" for bits in (16, 32, 64)}
DTYPES |= {getattr(torch, f"int{bits}"): f"I{bits}" for bits in (8, 16, 32, 64)}
DTYPES |= {torch.bfloat16: "BF16", torch.uint8: "U8", torch.bool: "BOOL"}


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
    nested = json.dumps(_flatten(content, tensors))
    # The widest elements first, so that all stand at multiples of their width.
    tensors = dict(sorted(tensors.items(), key=lambda item: -item[1].element_size()))
    sums = {}
    with atomic_write(path) as partial, partial.open("wb") as file:
        file.write(_header(nested, tensors, UNKNOWN))
        for name, tensor in tensors.items():
            data = _data(tensor)
            sums[name] = _sum(tensor, data)
            file.write(data)
        file.seek(0)
        file.write(_header(nested, tensors, _digest(nested, sums)))


def read_checkpoint_file(path: Path) -> dict[str, Any]:
    """The content of a checkpoint file, on the host.

    Raises:
        DevrfError: the file is damaged, of another format, or not devrf's.
    """
    metadata = file_metadata(path)
    need_memory(path.stat().st_size, f"{path}: it")
    with safe_open(path, "pt") as file:
        # The library maps the file into memory: a copy does not change with it.
        tensors = {name: file.get_tensor(name).clone() for name in file.keys()}
    supported = all(tensor.dtype in DTYPES for tensor in tensors.values())
    sums = {name: _sum(tensor, _data(tensor)) for name, tensor in tensors.items() if supported}
    if not supported or _digest(metadata["nested"], sums) != metadata["sha256"]:
        raise DevrfError(
            f"{path}: damaged: altered since it was written (its checksum does not match); take a "
            "copy that is whole, or train again"
        )
    return _content(path, metadata, tensors)


def read_description(path: Path) -> dict[str, Any]:
    """The content of a checkpoint file with None for each tensor; only its header is read.

    Altered bytes are not noticed: :func:`read_checkpoint_file` reads a file for further use.

    Raises:
        DevrfError: the file does not begin as devrf's of this format.
    """
    return _content(path, file_metadata(path), defaultdict(lambda: None))


def _content(path: Path, metadata: Mapping[str, str], tensors: Mapping[str, Any]) -> dict[str, Any]:
    try:
        content: dict[str, Any] = _unflatten(json.loads(metadata["nested"]), tensors)
    except UNREADABLE:
        raise DevrfError(f"{path}: damaged; take a copy that is whole, or train again") from None
    return content


def _header(nested: str, tensors: Mapping[str, Tensor], digest: str) -> bytes:
    """The beginning of a safetensors file: eight bytes of the header's length, then its JSON."""
    entries: dict[str, Any] = {
        "__metadata__": {"devrf": FORMAT, "sha256": digest, "nested": nested}
    }
    total = 0
    for name, tensor in tensors.items():
        begin = total
        total += tensor.nbytes
        shape = list(tensor.shape)
        dtype = DTYPES[tensor.dtype]
        entries[name] = {"dtype": dtype, "shape": shape, "data_offsets": [begin, total]}
    header = json.dumps(entries).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header


def _sum(tensor: Tensor, data: memoryview) -> str:
    return f"{DTYPES[tensor.dtype]} {list(tensor.shape)} {hashlib.sha256(data).hexdigest()}"


def _digest(nested: str, sums: Mapping[str, str]) -> str:
    """The SHA-256 of a file's content, whatever the order of its tensors."""
    content = json.dumps([nested, sorted(sums.items())])
    return hashlib.sha256(content.encode()).hexdigest()


def _data(tensor: Tensor) -> memoryview:
    """A tensor's elements as bytes on the host."""
    return tensor.cpu().contiguous().view(-1).view(torch.uint8).numpy().data


def _flatten(value: Any, tensors: dict[str, Tensor], name: str = "") -> Any:
    """Nested data as JSON, with objects for tensors, dicts, tuples and sets.

    ``tensors`` gets the tensors in ``value``, each by its path (``name``) from the outermost dict.

    Raises:
        TypeError: there is something else in it.
    """
    if isinstance(value, Tensor):
        while name in tensors:  # as with the keys 1 and "1"
            name += "'"
        tensors[name] = value.detach()
        return {"tensor": name}
    if isinstance(value, dict):
        pairs = value.items()
        return {"dict": [[_flatten(k, {}), _flatten(v, tensors, f"{name}/{k}")] for k, v in pairs]}
    if isinstance(value, list | tuple | set):
        items = [_flatten(item, tensors, f"{name}/{k}") for k, item in enumerate(value)]
        kind = "tuple" if isinstance(value, tuple) else "set"
        return items if isinstance(value, list) else {kind: items}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{name}: a checkpoint cannot hold a {type(value).__name__}")


def _unflatten(node: Any, tensors: Mapping[str, Any]) -> Any:
    """The nested data that :func:`_flatten` made ``node`` and ``tensors`` of."""
    if isinstance(node, list):
        return [_unflatten(item, tensors) for item in node]
    if not isinstance(node, dict):
        return node
    ((kind, value),) = node.items()
    if kind == "tensor":
        return tensors[value]
    if kind == "dict":
        return {_key(k): _unflatten(v, tensors) for k, v in value}
    if kind == "set":
        return {_key(item) for item in value}
    if kind == "tuple":
        return tuple(_unflatten(item, tensors) for item in value)
    raise ValueError(kind)


def _key(value: Any) -> Any:
    """A key or a set's member: text, or a number none of whose multiples have one hash."""
    if isinstance(value, str) or (isinstance(value, int) and abs(value) < 2**53):
        return value
    raise ValueError(value)
