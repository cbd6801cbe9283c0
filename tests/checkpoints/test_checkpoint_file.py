"""Checkpoint files: whole or not at all, every altered byte noticed, nothing hostile obeyed."""

from __future__ import annotations

import hashlib
import json
import random
import re
import resource
import struct
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from devrf.checkpoints import checkpoint_file as module
from devrf.checkpoints.checkpoint_file import (
    DTYPES,
    FORMAT,
    LONGEST_HEADER,
    digest_of,
    read_checkpoint_file,
    read_description,
    write_checkpoint_file,
)
from devrf.errors import DevrfError

GRID = torch.arange(600.0).view(2, 3, 100)
PLAIN = [1, 2.5, "three\n", None, True, (4, (5, [])), {6, 7}, {0: {"0": float("inf")}}]
CONTENT: dict[str, Any] = {"fields": {"density": GRID, "mask": torch.ones(9) > 0}, "plain": PLAIN}
WRONG_CONTENT = "its content is not devrf's"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A checkpoint file, alone in its folder."""
    write_checkpoint_file(tmp_path / "run" / "some.ckpt", CONTENT)
    return tmp_path / "run" / "some.ckpt"


def refusal(path: Path, data: bytes | None = None) -> str:
    """What is said of a file that is refused: one line that begins with its name."""
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(DevrfError) as caught:
        read_checkpoint_file(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message


def sealed(nested: str, entries: dict[str, Any], data: bytes, version: int = FORMAT) -> bytes:
    """A file whose seal fits, whatever it says."""
    seal = {"devrf": str(version), "bytes": str(len(data)), "sha256": "", "nested": nested}
    header = json.dumps({"__metadata__": seal, **entries}).encode()
    length = (len(header) + 64).to_bytes(8, "little")
    begin, end = header.split(b'"sha256": "', 1)
    begin = length + begin + b'"sha256": "'
    digest = hashlib.sha256(begin + end + data).hexdigest().encode()
    return begin + digest + end + data


def test_plain_values_come_back_as_they_were(path: Path) -> None:
    assert repr(read_checkpoint_file(path)["plain"]) == repr(PLAIN)
    assert [p.name for p in path.parent.iterdir()] == ["some.ckpt"]


@pytest.mark.parametrize("dtype", DTYPES)
def test_tensors_of_every_type_come_back_bit_for_bit(path: Path, dtype: torch.dtype) -> None:
    tensors = [torch.tensor([[0, 1, 3], [1, 0, 2]]).to(dtype), torch.tensor(1).to(dtype)]
    write_checkpoint_file(path, {"odd": torch.ones(3, dtype=torch.bool), "all": tensors})
    back = read_checkpoint_file(path)["all"]
    torch.testing.assert_close(back, tensors, rtol=0, atol=0)


@pytest.mark.parametrize(
    "tensor",
    [GRID[:, 1], GRID.movedim(0, 2), torch.zeros(0, 3), torch.nn.Parameter(torch.ones(2))],
    ids=["view", "transposed", "empty", "parameter"],
)
def test_a_tensor_is_stored_by_its_elements(path: Path, tensor: torch.Tensor) -> None:
    write_checkpoint_file(path, {1: tensor, "1": tensor, "whole": torch.zeros(1)})
    back = read_checkpoint_file(path)
    assert path.stat().st_size < 1000 + 2 * tensor.nbytes
    torch.testing.assert_close([back[1], back["1"]], [tensor.detach()] * 2, rtol=0, atol=0)
    assert not back[1].requires_grad


def test_what_was_read_does_not_follow_the_file(path: Path) -> None:
    back = read_checkpoint_file(path)
    with path.open("rb+") as file:
        file.write(bytes(path.stat().st_size))
    assert torch.equal(back["fields"]["density"], GRID)


def test_safetensors_reads_it_too(path: Path) -> None:
    tensors = load_file(path)
    assert set(tensors) == {"/fields/density", "/fields/mask"}
    assert torch.equal(tensors["/fields/density"], GRID)


def test_what_cannot_be_stored_is_named(path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(TypeError, match="^/a/0: a checkpoint cannot hold a PosixPath"):
        write_checkpoint_file(path, {"a": [Path("b")]})
    assert path.read_bytes() == before


def test_the_digest_tells_contents_apart(path: Path) -> None:
    other = path.with_name("other.ckpt")
    write_checkpoint_file(other, {**CONTENT, "plain": []})
    assert len(digest_of(path)) == 64
    assert digest_of(path) != digest_of(other)
    write_checkpoint_file(other, CONTENT)
    assert digest_of(path) == digest_of(other)
    other.write_bytes(b"something else")
    assert digest_of(other) == ""


def test_a_description_is_read_without_tensors(path: Path) -> None:
    write_checkpoint_file(path, {"a": [1, torch.ones(3)], "b": {"c": "d"}})
    assert read_description(path) == {"a": [1, None], "b": {"c": "d"}}
    path.write_bytes(path.read_bytes()[:-4])  # which only a whole reading notices
    assert read_description(path)["a"][0] == 1
    for damaged in (path.read_bytes()[:200], b"", b"\0" * 300):
        path.write_bytes(damaged)
        with pytest.raises(DevrfError, match=f"{path}: not a devrf checkpoint"):
            read_description(path)


def test_every_altered_bit_is_noticed(path: Path) -> None:
    whole, noise = path.read_bytes(), random.Random(0)
    # Every byte of the seal, and a hundred of the rest.
    for place in [*range(200), *(noise.randrange(len(whole)) for _ in range(100))]:
        altered = bytearray(whole)
        altered[place] ^= 1 << noise.randrange(8)
        assert re.search("damaged|not a devrf checkpoint", refusal(path, altered)), place
    altered = bytearray(whole)
    altered[whole.index(struct.pack("<f", 300.0))] ^= 1
    assert "damaged: altered since it was written" in refusal(path, altered)


def test_every_missing_or_added_byte_is_noticed(path: Path) -> None:
    whole, noise = path.read_bytes(), random.Random(1)
    for length in [200, len(whole) - 1, *(noise.randrange(200, len(whole)) for _ in range(30))]:
        assert f"damaged: truncated, {length} bytes where" in refusal(path, whole[:length])
    for length in range(130):
        assert "only the first bytes of one" in refusal(path, whole[:length])
    message = refusal(path, whole[:500] + b"more" + whole[500:])
    assert f"damaged: altered, {len(whole) + 4} bytes where {len(whole)} were written" in message


def test_files_of_others_are_refused(tmp_path: Path) -> None:
    noise, path = random.Random(0), tmp_path / "some.ckpt"
    for _ in range(100):
        data = noise.randbytes(noise.randrange(1, 200))
        assert "not a devrf checkpoint" in refusal(path, data)
    assert "not a devrf checkpoint" in refusal(path, b"scene: robot\n" * 20)
    torch.save(GRID, path)
    assert "not a devrf checkpoint" in refusal(path)
    save_file({"grid": GRID}, path, metadata={"nested": "{}"})
    assert "not a devrf checkpoint" in refusal(path)


def test_other_formats_are_named(path: Path) -> None:
    end_of_2 = b"\x89devrf\r\n" + struct.pack("<IQ", 2, 400) + bytes(32)
    older = refusal(path, b"PK\x03\x04" + bytes(396) + end_of_2)
    assert f"has format 2, older than the {FORMAT} that this version reads" in older
    newer = refusal(path, sealed("{}", {}, b"", FORMAT + 1))
    assert f"has format {FORMAT + 1}, newer than the {FORMAT}" in newer


def entry(shape: list[int], begin: int, end: int) -> dict[str, Any]:
    return {"dtype": "F32", "shape": shape, "data_offsets": [begin, end]}


# A file of 40 bytes of data: its nested data, and what its header says of its tensors.
NO_TENSOR: dict[str, Any] = {"a": entry([10], 0, 40)}
HOSTILE: dict[str, tuple[str, dict[str, Any]]] = {
    "a tensor larger than the file": ("{}", {"a": entry([10**12], 0, 4 * 10**12)}),
    "a tensor larger than its bytes": ("{}", {"a": entry([10**9, 10], 0, 40)}),
    "tensors that overlap": ("{}", {"a": entry([10], 0, 40), "b": entry([10], 0, 40)}),
    "a tensor that is not there": ('{"tensor": "b"}', NO_TENSOR),
    "a list for a tensor's name": ('{"tensor": []}', NO_TENSOR),
    "a tensor alone": ('{"tensor": "a"}', NO_TENSOR),
    "a list": ("[1, 2]", NO_TENSOR),
    "no JSON": ("{", NO_TENSOR),
    "an unknown type": ('{"dict": [["a", {"object": []}]]}', NO_TENSOR),
    "two types": ('{"dict": [], "list": []}', NO_TENSOR),
    "a key that is a list": ('{"dict": [[[], 1]]}', NO_TENSOR),
    "endless depth": ("[" * 10**6, NO_TENSOR),
    "many lists": ("[" + "[]," * 10**6 + "[]]", NO_TENSOR),
}


def held() -> float:
    """The most memory that this process has held, in GiB."""
    unit = 1 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


@pytest.mark.parametrize("claim", HOSTILE)
def test_claims_are_not_believed(tmp_path: Path, claim: str) -> None:
    before = held()
    nested, entries = HOSTILE[claim]
    assert WRONG_CONTENT in refusal(tmp_path / "h.ckpt", sealed(nested, entries, bytes(40)))
    assert held() - before < 0.5


def test_an_endless_header_is_not_read(tmp_path: Path) -> None:
    data = sealed(" " * LONGEST_HEADER, {}, b"")
    assert "not a devrf checkpoint" in refusal(tmp_path / "h.ckpt", data)


@pytest.mark.parametrize("after", [0, 1])
@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["full", "ended"]
)
def test_a_failed_write_leaves_the_file_of_before(
    path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, after: int
) -> None:
    before, usual, written = path.read_bytes(), module._data, []

    def fail(tensor: torch.Tensor) -> memoryview:
        if len(written) == after:
            raise error
        written.append(tensor)
        return usual(tensor)

    monkeypatch.setattr(module, "_data", fail)
    with pytest.raises(type(error)) as caught:
        write_checkpoint_file(path, CONTENT)
    if isinstance(caught.value, OSError):
        assert (caught.value.errno, caught.value.filename) == (28, str(path))
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["some.ckpt"]


def test_a_limit_of_the_system_leaves_the_file_of_before(path: Path) -> None:
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            write_checkpoint_file(path, {"other": torch.zeros(50_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.filename == str(path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["some.ckpt"]
