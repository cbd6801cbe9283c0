"""Small files that claim, or unpack to, enormous things: refused early, in little memory."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

GIB = 2**30
# Of 16 MiB: all that fits into an archive that is no larger than its images explain.
BLOCKS = 60
# All of them take some ten seconds on one quiet core.
MOST_SECONDS = 120


def sparse(path: Path, size: int, head: bytes = b"") -> Path:
    """A file of any size that takes no room on the disk."""
    path.write_bytes(head)
    os.truncate(path, size)
    return path


def npy(shape: tuple[int, ...], kind: str = "<f8", data: bytes = b"") -> bytes:
    text = repr({"descr": kind, "fortran_order": False, "shape": shape}).encode() + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + data


def npz(path: Path, members: dict[str, bytes], zeros: int = 0) -> Path:
    """An archive, by hand; ``zeros`` × 16 MiB of zeros, packed, follow on the first member."""
    packer = zlib.compressobj(9, wbits=-15)
    block = packer.compress(b"\0" * 2**24) + packer.flush(zlib.Z_FULL_FLUSH)
    body, index = b"", b""
    for name, data in members.items():
        packer = zlib.compressobj(9, wbits=-15)
        packed = packer.compress(data) + packer.flush(zlib.Z_FULL_FLUSH) + block * zeros
        packed += zlib.compressobj(wbits=-15).flush()
        size, zeros = len(data) + zeros * 2**24, 0
        common = struct.pack(
            "<HHHHHIIIHH", 20, 0, 8, 0, 0, zlib.crc32(data), len(packed), size, len(name) + 4, 0
        )
        named = f"{name}.npy".encode()
        index += b"PK\1\2\x14\0" + common + struct.pack("<HHHII", 0, 0, 0, 0, len(body)) + named
        body += b"PK\3\4" + common + named + packed
    end = struct.pack("<HHHHIIH", 0, 0, len(members), len(members), len(index), len(body), 0)
    path.write_bytes(body + index + b"PK\5\6" + end)
    return path


def png(path: Path, side: int, rows: int = 0, whole: bool = True) -> Path:
    """A clear image whose data end after ``rows`` of its rows; the file too unless ``whole``."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 6, 0, 0, 0))
    data = chunk(b"IDAT", zlib.compress(b"\0" * (rows * (4 * side + 1))))
    path.parent.mkdir(exist_ok=True)
    image = b"\x89PNG\r\n\x1a\n" + header + data + chunk(b"IEND", b"")
    path.write_bytes(image if whole else image[:-1000])
    return path


def eight_of(image: Path) -> Path:
    for k in range(1, 8):
        shutil.copyfile(image, image.with_name(f"{k}.png"))
    return image.parent


def listing(path: Path, count: int) -> Path:
    """A transforms file of ``count`` frames whose images are not there."""
    frame = {
        "file_path": "images/none.png",
        "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    }
    text = ",".join([json.dumps(frame, separators=(",", ":"))] * count)
    path.write_text(f'{{"camera_angle_x":1,"frames":[{text}]}}')
    return path


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


VECTORS = npy((4, 6, 2), "<f4", bytes(192))
MASK = npy((4, 6), "|b1", bytes(24))
KEY = npy((), "<U64", "".join("0" * 64).encode("utf-32-le"))
# Just under the number of values that a file may hold, each as large as a value can be.
DENSEST = '{"a":[' + ",".join(["[" * 150 + "]" * 150] * 26_000) + "]}"

# What reads each, what the message says (None: it is read), and how the file is made.
CASES: dict[str, tuple[str, str | None, Callable[[Path], Path]]] = {
    "json of 100 GB": ("json", "larger than 64 MiB", lambda p: sparse(p, 10**11, b'{"a": 1}')),
    "json of too many values": (
        "json",
        "more than 4 million values",
        lambda p: text(p, "[" + "[]," * 2_500_000 + "0]"),
    ),
    "json that is as dense as it may be": ("json", None, lambda p: text(p, DENSEST)),
    "json of a million levels": ("json", "not valid JSON", lambda p: text(p, "[" * 1_000_000)),
    "a number of 50 million digits": (
        "json",
        "should be an object",
        lambda p: text(p, "0." + "1" * 50_000_000),
    ),
    "90,000 images that are not there": (
        "transforms",
        "none.png: no such image",
        lambda p: listing(p, 90_000),
    ),
    "npy of a petabyte": ("npy", "do not fit", lambda p: sparse(p, 4096, npy((10**14, 17)))),
    "npy of a terabyte that is there": (
        "npy",
        "which is too large",
        lambda p: sparse(p, 2**40, npy((2**30, 17))),
    ),
    "npy with a header of 4 GB": (
        "npy",
        "format version",
        lambda p: sparse(p, 2**33, b"\x93NUMPY\2\0\xff\xff\xff\xff"),
    ),
    "flow of a petabyte": (
        "flow",
        "expected (4, 6, 2)",
        lambda p: npz(p, {"flow": npy((10**14, 17)), "mask": MASK}),
    ),
    "flow of wide values": (
        "flow",
        "in the shape",
        lambda p: npz(p, {"flow": npy((4, 6, 2), "|S1000000000"), "mask": MASK}),
    ),
    "flow that unpacks to a gigabyte": (
        "flow",
        "goes on after its end",
        lambda p: npz(p, {"flow": VECTORS, "mask": MASK}, BLOCKS),
    ),
    "flow whose header unpacks to a gigabyte": (
        "flow",
        "format version",
        lambda p: npz(p, {"flow": b"\x93NUMPY\2\0\xff\xff\xff\xff", "mask": MASK}, BLOCKS),
    ),
    "flow of 100 GB": ("flow", "larger than 1 MiB", lambda p: sparse(p, 10**11, b"PK\3\4")),
    "cache of a petabyte": (
        "cache",
        "no cache",
        lambda p: npz(p, {"key": KEY, "vectors": npy((10**14, 17), "<f4"), "valid": MASK}),
    ),
    "cache whose key unpacks to a gigabyte": (
        "cache",
        "no cache",
        lambda p: npz(p, {"key": KEY, "vectors": VECTORS, "valid": MASK}, BLOCKS),
    ),
    "images of 2³¹ pixels a side": (
        "images",
        "100 megapixels",
        lambda p: png(p / "a.png", 2**31 - 1).parent,
    ),
    "8 images of 99 megapixels whose files end early": (
        "images",
        "not a readable image",
        lambda p: eight_of(png(p / "0.png", 9950, 9000, whole=False)),
    ),
    "8 images of 99 megapixels whose data end early": (
        "images",
        "cannot come from files",
        lambda p: eight_of(png(p / "0.png", 9950, 800)),
    ),
    "10,000 images of 99 megapixels": (
        "many images",
        "cannot come from files",
        lambda p: png(p, 9950),
    ),
}


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory) -> Iterator[dict[str, Any]]:
    """What became of each case: message, seconds, bytes; the process is killed when it hangs."""
    folder = tmp_path_factory.mktemp("hostile")
    listed = [
        [name, reader, str(make(folder / f"{k}"))]
        for k, (name, (reader, _, make)) in enumerate(CASES.items())
    ]
    script = Path(__file__).with_name("read_hostile.py")
    source = Path(__file__).parents[3] / "src"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(script)],
        input=json.dumps(listed),
        text=True,
        capture_output=True,
        timeout=MOST_SECONDS,
        env={**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    yield {line[0]: line[1:] for line in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize("name", CASES)
def test_it_costs_little(name, verdicts):
    message, took, grown = verdicts[name]
    said = CASES[name][1]
    assert message is None if said is None else said in message
    assert grown < GIB and took < 20


def test_the_cases_are_what_they_are_called(tmp_path):
    """The archives made by hand are whole ones, and unpack to what was put in."""
    path = npz(tmp_path / "f.npz", {"flow": VECTORS, "mask": MASK}, zeros=1)
    import zipfile

    with zipfile.ZipFile(path) as archive:
        assert archive.getinfo("flow.npy").file_size == len(VECTORS) + 2**24
        with archive.open("flow.npy") as member:
            assert np.lib.format.read_array(member).shape == (4, 6, 2)
            assert member.read(2**20) == b"\0" * 2**20
