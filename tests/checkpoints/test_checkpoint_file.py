"""Sealed files: written whole or not at all, every altered byte noticed, nothing hostile obeyed."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import random
import resource
import struct
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from devrf.checkpoints import checkpoint_file as sealed_file
from devrf.checkpoints.checkpoint_file import (
    FORMAT,
    HEAD,
    MARK,
    SEAL,
    digest_of,
    read_checkpoint_file,
    write_checkpoint_file,
)
from devrf.errors import DevrfError

CONTENT: dict[str, Any] = {
    "fields": {"density": torch.arange(600.0).view(2, 3, 100), "mask": torch.ones(9) > 0},
    "plain": [1, 2.5, "three", None, True, (4, 5)],
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A sealed file, alone in its folder."""
    write_checkpoint_file(tmp_path / "run" / "some.ckpt", CONTENT)
    return tmp_path / "run" / "some.ckpt"


def refusal(path: Path) -> str:
    """What is said of a file that is refused: one line that begins with its name."""
    with pytest.raises(DevrfError) as caught:
        read_checkpoint_file(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message


def sealed(path: Path, archive: bytes, version: int = FORMAT) -> Path:
    """A file with a seal that fits, whatever the archive holds."""
    head = HEAD.pack(MARK, version, len(archive))
    path.write_bytes(archive + head + hashlib.sha256(archive + head).digest())
    return path


def test_what_is_written_is_read_back(path: Path) -> None:
    content = read_checkpoint_file(path)
    assert torch.equal(content["fields"]["density"], CONTENT["fields"]["density"])
    assert torch.equal(content["fields"]["mask"], CONTENT["fields"]["mask"])
    assert content["plain"] == CONTENT["plain"]
    assert [p.name for p in path.parent.iterdir()] == ["some.ckpt"]


def test_the_digest_tells_contents_apart(path: Path) -> None:
    other = path.with_name("other.ckpt")
    write_checkpoint_file(other, {**CONTENT, "plain": []})
    assert len(digest_of(path)) == 64
    assert digest_of(path) != digest_of(other)
    other.write_bytes(path.read_bytes())
    assert digest_of(path) == digest_of(other)
    other.write_bytes(b"something else")
    assert digest_of(other) == ""


def test_torch_and_unzip_read_it_too(path: Path) -> None:
    assert torch.load(path, weights_only=True)["plain"] == CONTENT["plain"]
    assert zipfile.ZipFile(path).testzip() is None


def test_every_altered_bit_is_noticed(path: Path) -> None:
    whole, noise = path.read_bytes(), random.Random(0)
    # Every byte of head and tail, where the descriptions are, and a hundred of the rest.
    places = {*range(64), *range(len(whole) - 256, len(whole))}
    places |= {noise.randrange(len(whole)) for _ in range(100)}
    for place in sorted(places):
        altered = bytearray(whole)
        altered[place] ^= 1 << noise.randrange(8)
        path.write_bytes(altered)
        message = refusal(path)
        assert "damaged" in message or "not a" in message, place


def test_a_flipped_bit_in_a_tensor_is_named_so(path: Path) -> None:
    altered = bytearray(path.read_bytes())
    altered[altered.index(struct.pack("<f", 300.0))] ^= 1
    path.write_bytes(altered)
    assert torch.load(path, weights_only=True)  # torch alone does not notice
    assert "altered since it was written" in refusal(path)


def test_every_truncation_is_noticed(path: Path) -> None:
    whole, noise = path.read_bytes(), random.Random(1)
    lengths = {0, 1, 3, 4, *(noise.randrange(len(whole)) for _ in range(60))}
    for length in sorted(lengths | set(range(len(whole) - SEAL.size + 1, len(whole)))):
        path.write_bytes(whole[:length])
        message = refusal(path)
        assert "truncated" in message if length in {0, *range(4, len(whole))} else message, length
    # Cut exactly before its seal it cannot be told from a file of another program.
    path.write_bytes(whole[: -SEAL.size])
    assert "it has no seal" in refusal(path)


def test_bytes_put_in_between_are_noticed(path: Path) -> None:
    whole = path.read_bytes()
    path.write_bytes(whole[:500] + b"more" + whole[500:])
    assert f"{len(whole) - SEAL.size} were written" in refusal(path)


def test_files_of_noise_or_text_are_refused(tmp_path: Path) -> None:
    noise, path = random.Random(0), tmp_path / "some.ckpt"
    for _ in range(100):
        path.write_bytes(noise.randbytes(noise.randrange(1, 200)))
        assert "not a checkpoint" in refusal(path)
    path.write_text("scene: robot\n" * 20)
    assert "not a checkpoint" in refusal(path)


@pytest.mark.parametrize("content", [CONTENT, [1, 2], torch.zeros(3)])
def test_files_of_other_programs_are_refused(tmp_path: Path, content: object) -> None:
    path = tmp_path / "foreign.ckpt"
    torch.save(content, path)
    assert "not a devrf checkpoint: it has no seal" in refusal(path)


@pytest.mark.parametrize(("version", "words"), [(FORMAT + 1, "newer"), (FORMAT - 1, "older")])
def test_other_formats_are_named(path: Path, version: int, words: str) -> None:
    message = refusal(sealed(path, path.read_bytes()[: -SEAL.size], version))
    assert f"has format {version}, {words} than the {FORMAT} that this version reads" in message


class Bomb:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return self.path.touch, ()


def archive(**records: bytes) -> bytes:
    """An archive as ``torch.save`` makes them, with records of one's own."""
    into = io.BytesIO()
    with zipfile.ZipFile(into, "w") as packed:
        for name, record in {"version": b"3\n", "byteorder": b"little", **records}.items():
            packed.writestr(f"some/{name.replace('_', '.').replace('data.0', 'data/0')}", record)
    return into.getvalue()


def test_pickled_code_is_refused_and_not_run(tmp_path: Path) -> None:
    bomb = Bomb(tmp_path / "exploded")
    into = io.BytesIO()
    torch.save({"devrf": bomb}, into)
    assert "its content is not devrf's" in refusal(sealed(tmp_path / "1.ckpt", into.getvalue()))
    for protocol in range(6):
        hostile = archive(data_pkl=pickle.dumps(bomb, protocol))
        assert "its content is not" in refusal(sealed(tmp_path / f"p{protocol}.ckpt", hostile))
    assert not bomb.path.exists()


def a_tensor(numel: int, shape: tuple[int, ...], stride: tuple[int, ...]) -> bytes:
    """A pickle that claims a tensor of ``shape`` on a storage of ``numel`` floats."""

    class Pickler(pickle.Pickler):
        def persistent_id(self, one: object) -> Any:
            return ("storage", torch.FloatStorage, "0", "cpu", numel) if one is storage else None

    class Claim:
        def __reduce__(self) -> tuple[Any, ...]:
            return torch._utils._rebuild_tensor_v2, (  # type: ignore[attr-defined]
                storage,
                0,
                shape,
                stride,
                False,
                OrderedDict(),
            )

    storage, into = object(), io.BytesIO()
    Pickler(into, 2).dump({"a": Claim()})
    return into.getvalue()


HOSTILE: dict[str, Callable[[], bytes]] = {
    "a storage larger than its record": lambda: archive(
        data_pkl=a_tensor(10**12, (10**12,), (1,)), data_0=bytes(40)
    ),
    "a tensor larger than its storage": lambda: archive(
        data_pkl=a_tensor(10, (10**9,), (1,)), data_0=bytes(40)
    ),
    "a tensor that repeats its storage": lambda: archive(
        data_pkl=a_tensor(10, (10**9, 10), (0, 1)), data_0=bytes(40)
    ),
    "a call that takes memory": lambda: archive(
        data_pkl=b"\x80\x02c__builtin__\nbytearray\nJ" + struct.pack("<i", 2**31 - 1) + b"\x85R."
    ),
    "an endless description": lambda: archive(data_pkl=b"\x80\x02](" + b"}" * 2**21 + b"e."),
    "lists in lists": lambda: archive(data_pkl=doublings(40)),
    "no description": lambda: archive(),
    "a list that holds itself": lambda: archive(data_pkl=b"\x80\x02]q\x00h\x00a."),
}


def doublings(times: int) -> bytes:
    """A pickle of a list with two elements, each the same list with two elements, and so on."""
    lists: list[Any] = []
    for _ in range(times):
        lists = [lists, lists]
    return pickle.dumps(lists, 2)


def held() -> float:
    """The most memory that this process has held, in GiB."""
    unit = 1 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


@pytest.mark.parametrize("claim", HOSTILE)
def test_claims_are_not_believed(tmp_path: Path, claim: str) -> None:
    before = held()
    assert "its content is not" in refusal(sealed(tmp_path / "h.ckpt", HOSTILE[claim]()))
    assert held() - before < 0.5


def test_a_small_file_that_unfolds_is_refused(tmp_path: Path) -> None:
    into = io.BytesIO()
    with zipfile.ZipFile(into, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("some/data.pkl", a_tensor(4 * 10**7, (4 * 10**7,), (1,)))
        packed.writestr("some/data/0", bytes(16 * 10**7))
    assert len(into.getvalue()) < 10**6
    before = held()
    assert "its content is not" in refusal(sealed(tmp_path / "bomb.ckpt", into.getvalue()))
    assert held() - before < 0.1


def fails(error: BaseException, after: int) -> Callable[[sealed_file._Sealing, Any], int]:
    """A ``write`` of torch's target that fails once ``after`` bytes are written."""
    usual = sealed_file._Sealing.write

    class Full:
        def __init__(self, file: Any) -> None:
            self.file = file
            self.left = after

        def write(self, data: Any) -> int:
            count = memoryview(data).nbytes
            if count > self.left:
                self.file.write(memoryview(data).cast("B")[: self.left])
                raise error
            self.left -= count
            return int(self.file.write(data))

    def write(self: sealed_file._Sealing, data: Any) -> int:
        if not isinstance(self._file, Full):
            self._file = Full(self._file)  # type: ignore[assignment]
        return usual(self, data)

    return write


@pytest.mark.parametrize("after", [0, 100, 2000])
@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["full", "ended"]
)
def test_a_failed_write_leaves_the_file_of_before(
    path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, after: int
) -> None:
    before = path.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(sealed_file._Sealing, "write", fails(error, after))
        with pytest.raises(type(error)) as caught:
            write_checkpoint_file(path, {"other": torch.zeros(2000)})
    if isinstance(caught.value, OSError):
        assert (caught.value.errno, caught.value.filename) == (28, str(path))
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["some.ckpt"]


def test_a_limit_of_the_system_leaves_the_file_of_before(path: Path) -> None:
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            write_checkpoint_file(path, {"other": torch.zeros(50_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["some.ckpt"]


def test_the_name_is_given_only_when_the_content_is_on_the_disk(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[str] = []
    sync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (steps.append("sync"), sync(handle)))
    monkeypatch.setattr(os, "replace", lambda *names: (steps.append("name"), replace(*names)))
    write_checkpoint_file(path, CONTENT)
    assert steps == ["sync", "name", "sync"]  # the file, its name, the folder that has the name
