"""Checkpoint files: whole or not at all, damage noticed in one line, no code run."""

from __future__ import annotations

import json
import os
import random
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from devrf.checkpoints import checkpoint_file as module
from devrf.checkpoints.checkpoint_file import (
    DTYPES,
    UNKNOWN,
    _digest,
    _header,
    read_checkpoint_file,
    read_description,
    write_checkpoint_file,
)
from devrf.checkpoints.file_metadata import FORMAT, digest_of, latest_checkpoint
from devrf.errors import DevrfError
from devrf.system.memory import own_memory

GRID = torch.arange(600.0).view(2, 3, 100)
PLAIN = [1, 2.5, "three\n", None, True, (4, (5, [])), {6, 7}, {0: {"0": float("inf")}}]
CONTENT: dict[str, Any] = {"fields": {"density": GRID, "mask": torch.ones(9) > 0}, "plain": PLAIN}


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


def test_plain_values_come_back_as_they_were(path):
    assert repr(read_checkpoint_file(path)["plain"]) == repr(PLAIN)
    assert torch.equal(load_file(path)["/fields/density"], GRID)  # safetensors reads it, too
    assert [p.name for p in path.parent.iterdir()] == ["some.ckpt"]


def test_tensors_of_every_type_come_back_bit_for_bit(path):
    plain = torch.tensor([[0, 1, 3], [1, 0, 2]]), torch.tensor(1)
    tensors = [tensor.to(dtype) for dtype in DTYPES for tensor in plain]
    write_checkpoint_file(path, {"odd": torch.ones(3, dtype=torch.bool), "all": tensors})
    torch.testing.assert_close(read_checkpoint_file(path)["all"], tensors, rtol=0, atol=0)


@pytest.mark.parametrize(
    "tensor",
    [GRID[:, 1], GRID.movedim(0, 2), torch.zeros(0, 3), torch.nn.Parameter(torch.ones(2))],
    ids=["view", "transposed", "empty", "parameter"],
)
def test_a_tensor_is_stored_by_its_elements(path, tensor):
    write_checkpoint_file(path, {1: tensor, "1": tensor, "whole": torch.zeros(1)})
    back = read_checkpoint_file(path)
    assert path.stat().st_size < 1000 + 2 * tensor.nbytes
    torch.testing.assert_close([back[1], back["1"]], [tensor.detach()] * 2, rtol=0, atol=0)
    assert not back[1].requires_grad


def test_what_cannot_be_stored_is_named(path):
    before = path.read_bytes()
    with pytest.raises(TypeError, match="^/a/0: a checkpoint cannot hold a PosixPath"):
        write_checkpoint_file(path, {"a": [Path("b")]})
    assert path.read_bytes() == before


def test_the_digest_tells_contents_apart(path):
    other = path.with_name("other.ckpt")
    write_checkpoint_file(other, {**CONTENT, "plain": []})
    assert len(digest_of(path)) == 64 and digest_of(path) != digest_of(other)
    write_checkpoint_file(other, CONTENT)
    assert digest_of(path) == digest_of(other)
    other.write_bytes(b"something else")
    assert digest_of(other) == ""


def test_a_description_is_read_without_tensors(path):
    write_checkpoint_file(path, {"a": [1, torch.ones(3)], "b": {"c": "d"}})
    assert read_description(path) == {"a": [1, None], "b": {"c": "d"}}
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(DevrfError, match=f"{path}: not a devrf checkpoint"):
        read_description(path)


def test_damage_is_noticed(path):
    whole, noise = path.read_bytes(), random.Random(0)
    data = int.from_bytes(whole[:8], "little") + 8
    for place in (*range(8, 100, 5), *(noise.randrange(data, len(whole)) for _ in range(10))):
        altered = bytearray(whole)
        altered[place] ^= 1 << noise.randrange(8)
        refusal(path, bytes(altered))
    for length in (0, 7, 200, len(whole) - 1):
        assert "damaged" in refusal(path, whole[:length])
    assert "damaged" in refusal(path, whole[:500] + b"more" + whole[500:])
    # What is said in JSON counts, too.
    assert "its checksum does not match" in refusal(path, whole.replace(b"three", b"Three"))


def test_files_of_others_are_refused(tmp_path):
    path = tmp_path / "some.ckpt"
    assert "not a devrf checkpoint" in refusal(path, b"scene: robot\n" * 20)
    torch.save(GRID, path)
    assert "not a devrf checkpoint" in refusal(path)
    save_file({"grid": GRID}, path, metadata={"nested": "{}"})
    assert "not a devrf checkpoint" in refusal(path)
    hostile = {
        "__metadata__": {},
        "a": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 40]},
    }
    header = json.dumps(hostile).encode()
    assert "not a devrf" in refusal(path, len(header).to_bytes(8, "little") + header + bytes(40))


@pytest.mark.parametrize("dtype", [torch.uint16, torch.complex64, torch.float8_e4m3fn])
def test_tensors_of_types_that_devrf_does_not_store_are_refused(path, dtype):
    metadata = {"devrf": FORMAT, "sha256": UNKNOWN, "nested": "{}"}
    save_file({"grid": torch.zeros(3).to(dtype)}, path, metadata=metadata)
    assert "damaged" in refusal(path)
    save_file({}, path, metadata=metadata | {"devrf": "5" * 10_000})
    assert len(refusal(path)) < 1000


def test_a_long_header_does_not_fill_memory(path):
    """Three million lists in 9 MB would take 0.4 GB, and those that 100 MB hold 4 GB."""
    nested = f'{{"dict": [["devrf", [{",".join(["[]"] * 3_000_000)}]]]}}'
    path.write_bytes(_header(nested, {}, _digest(nested, {})))
    before = own_memory()
    for read in (read_checkpoint_file, read_description):
        with pytest.raises(DevrfError, match="not a devrf checkpoint"):
            read(path)
    assert own_memory() - before < 50e6


def test_a_failed_write_leaves_the_file_of_before(path, monkeypatch):
    before = path.read_bytes()

    def fail(tensor: torch.Tensor) -> memoryview:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "_data", fail)
    with pytest.raises(OSError) as caught:
        write_checkpoint_file(path, CONTENT)
    assert (caught.value.errno, caught.value.filename) == (28, str(path))
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["some.ckpt"]


def test_the_latest_checkpoint_is_told_by_what_files_hold(tmp_path):
    folder = tmp_path / "checkpoints"

    def write(name: str, stages: int, iteration: int | None = None) -> None:
        records = {str(k): {} for k in range(stages)}
        progress = None if iteration is None else {"iteration": iteration}
        metadata = {"records": records, "training_config": {}}
        write_checkpoint_file(folder / name, {"devrf": metadata, "progress": progress})
        os.utime(folder / name, (1e9 - stages, 1e9 - (iteration or 0)))  # the latest is the oldest

    assert latest_checkpoint(tmp_path) is None
    files = [
        ("a-progress-99.ckpt", 1, 99),
        ("a-progress-100.ckpt", 1, 100),
        ("a.ckpt", 1, None),
        ("b-progress-5.ckpt", 2, 5),
        ("b.ckpt", 2, None),
    ]
    for name, stages, iteration in files:
        write(name, stages, iteration)
        assert latest_checkpoint(tmp_path) == folder / name
    broken = {"devrf": {"records": 7, "training_config": {}}, "progress": {"iteration": 10**400}}
    for content in ({"devrf": []}, {}, broken):
        write_checkpoint_file(folder / "c.ckpt", content)
        assert latest_checkpoint(tmp_path) == folder / "b.ckpt"
