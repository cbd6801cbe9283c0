"""Damage of every kind for files of every kind, and what may come of reading them."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

from devrf.errors import DevrfError
from devrf.scenes.scene import Scene

SMALL_NUMBERS = [0, -1, 1, 2, 0.5, -0.0, 1e-3, 5e-324, 1e-30]
LARGE_NUMBERS = [1e5, 1e9, 1e20, 1e38, 1e300, 2**31, 2**63, 10**400]
NUMBERS = [*SMALL_NUMBERS, *LARGE_NUMBERS, float("nan"), float("inf"), float("-inf")]
PATHS = ["../../secret", "/etc/passwd", "train/r_000", "./train/r_000.png", "images/0.png"]
ODD_TEXTS = ["a\0b", "\ud800", "\x1b[2J\r\n", "\U0001f916", "x" * 5000]
TEXTS = ["", "a", ".", "..", "/", "~", "000001", "OPENCV", *PATHS, *ODD_TEXTS]
# Texts, so that every draw is a value of its own.
CONTAINERS = [
    "[]",
    "{}",
    "[[]]",
    '{"": {}}',
    "[0, 0, 0, 0]",
    str([[0] * 4] * 4),
    str(list(range(50))),
    "[" * 300 + "]" * 300,
]

JSON_VALUES: SearchStrategy[Any] = st.one_of(
    st.sampled_from(NUMBERS),
    st.sampled_from(TEXTS),
    st.sampled_from([None, True, False]),
    st.sampled_from(CONTAINERS).map(json.loads),
    st.floats(),
    st.integers(-3, 3),
)


@st.composite
def edited_json(draw: DrawFn, content: Any) -> str:
    """The text of ``content`` after one to three changes, each at any place in it."""
    changed = json.loads(json.dumps(content))  # twice as quick as copy.deepcopy
    for _ in range(draw(st.integers(1, 3))):
        changed = _edited(draw, changed)
    return json.dumps(changed)


def _edited(draw: DrawFn, node: Any) -> Any:
    """``node`` with a change in it or below it, or something else in its place."""
    keys = list(node) if isinstance(node, dict) else []
    if isinstance(node, list):
        keys = list(range(len(node)))
    if not keys or draw(st.integers(0, 5)) == 0:
        return draw(st.one_of(JSON_VALUES, JSON_VALUES, st.builds(lambda: [node])))
    key = draw(st.sampled_from(keys))
    change = draw(st.sampled_from(["deeper"] * 5 + ["delete", "double", "swap"]))
    if change == "deeper":
        node[key] = _edited(draw, node[key])
    elif change == "delete":
        del node[key]
    elif change == "swap":
        other = draw(st.sampled_from(keys))
        node[key], node[other] = node[other], node[key]
    elif isinstance(node, list):
        node.insert(key, json.loads(json.dumps(node[key])))
    else:
        node[draw(st.sampled_from(keys))] = node[key]
    return node


CHUNKS = st.one_of(
    st.binary(min_size=1, max_size=8),
    st.sampled_from([b"\0" * 4, b"\xff" * 4, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0" * 64]),
)


@st.composite
def damaged_bytes(draw: DrawFn, data: bytes) -> bytes:
    """``data`` after one to four changes; both ends, where headers are, are hit more often."""
    for _ in range(draw(st.integers(1, 4))):
        size = len(data)
        at = draw(
            st.one_of(
                st.integers(0, size),
                st.integers(0, min(size, 64)),
                st.integers(max(0, size - 96), size),
            )
        )
        change = draw(st.sampled_from(["flip", "write", "insert", "cut", "delete", "repeat"]))
        if change == "flip" and at < size:
            data = data[:at] + bytes([data[at] ^ 1 << draw(st.integers(0, 7))]) + data[at + 1 :]
        elif change == "write":
            chunk = draw(CHUNKS)
            data = data[:at] + chunk + data[at + len(chunk) :]
        elif change == "insert":
            data = data[:at] + draw(CHUNKS) + data[at:]
        elif change == "cut":
            data = data[:at]
        else:
            end = draw(st.integers(at, size))
            data = data[:at] + data[at:end] * (2 if change == "repeat" else 0) + data[end:]
    return data


LENGTHS = st.sampled_from([-1, 0, 1, 2, 3, 5, 14, 17, 2**31, 2**63, 10**15, 10**30])
PLAIN_TYPES = ["<f8", ">f4", "<f2", "|b1", "|u1", "<i8", "<c16", "<f16", "f"]
OTHER_TYPES = ["|O", "<U5", "|S0", "|V8", "<M8[s]", "", "|S1000000000", ("<f8", (2,))]
NO_TYPES = [None, 3, [], [("a", "<f8")], [("a", "|O")], {"a": 1}]
DESCRIPTIONS = st.sampled_from([*PLAIN_TYPES, *OTHER_TYPES, *NO_TYPES])


@st.composite
def headed_npy(draw: DrawFn, values: np.ndarray) -> bytes:
    """``values`` behind an npy header that claims something else."""
    header: Any = {
        "descr": values.dtype.str,
        "fortran_order": draw(st.booleans()),
        "shape": values.shape,
    }
    for _ in range(draw(st.integers(1, 2))):
        key = draw(st.sampled_from(["shape", "shape", "descr", "descr", "fortran_order", "extra"]))
        header[key] = draw(
            {
                "shape": st.one_of(
                    st.lists(LENGTHS, max_size=4).map(tuple),
                    st.sampled_from([None, "x", 3, [2, 2]]),
                ),
                "descr": DESCRIPTIONS,
            }.get(key, JSON_VALUES)
        )
    whole = repr(header)
    drawn = draw(st.sampled_from([*[whole] * 4, whole[:-1], "(" * 150, "-" * 5000 + "1", "\t{"]))
    text = drawn.encode("latin-1", "replace")[:65000] + b"\n"
    version = draw(st.sampled_from([b"\1\0"] * 8 + [b"\2\0", b"\3\0", b"\0\0", b"\xff\xff"]))
    size = len(text).to_bytes(2 if version == b"\1\0" else 4, "little")
    return b"\x93NUMPY" + version + size + text + values.tobytes()


@st.composite
def edited_array(draw: DrawFn, values: np.ndarray) -> np.ndarray:
    """``values`` with some numbers put in their places, or of another shape or type."""
    values = values.astype(np.float64)
    for _ in range(draw(st.integers(1, 4))):
        number = st.one_of(st.sampled_from([n for n in NUMBERS if n != 10**400]), st.floats())
        values.flat[draw(st.integers(0, values.size - 1))] = draw(number)
    cut = draw(st.integers(-1, 6))
    if cut > 0:
        values = values[:cut] if cut % 2 else values[..., :cut]
    kind = draw(st.sampled_from(["f8"] * 8 + ["f4", ">f8", "f2", "i4", "c16", "U8", "?"]))
    with np.errstate(all="ignore"):
        return values.astype(kind)


class Hang(BaseException):
    """Reading took far longer than it may; no Exception, so that no reader can catch it."""


@contextmanager
def seconds(limit: float) -> Iterator[None]:
    """Raises :class:`Hang` in the block when it takes longer than ``limit`` seconds."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def check_message(error: DevrfError, folder: Path) -> None:
    """One short line that names a file of ``folder`` or a key."""
    message = str(error)
    assert len(message) < 500 and len(message.splitlines()) == 1 and message.isprintable(), message
    where = message.split(": ")[0]
    assert str(folder) in message or where.startswith("data.") or where.endswith(".png"), message


def check_scene(scene: Scene) -> None:
    """A scene that everything above can work with."""
    captures = scene.static, scene.dynamic
    for views in [views for capture in captures for views in (capture.train, capture.test)]:
        count, height, width, channels = views.pixels.shape
        cameras = views.cameras
        assert count > 0 and channels in (3, 4) and views.pixels.dtype == torch.uint8
        assert (cameras.width, cameras.height, len(cameras)) == (width, height, count)
        for values in (cameras.camera_to_world, cameras.focal, cameras.center):
            assert bool(values.isfinite().all()) and float(values.abs().max()) < 1e15
        assert float(cameras.focal.min()) > 0
        assert bool(((views.times >= 0) & (views.times <= 1)).all())
        assert len(views.names) == len(views.view) == len(views.times) == count
        if views.flow is not None:
            assert bool(views.flow.vectors.isfinite().all())
            assert not bool(views.flow.vectors[~views.flow.valid].any())
    bounds = scene.bounds
    corners = torch.tensor([bounds.box.low, bounds.box.high])
    assert bool(corners.isfinite().all()) and 0 <= bounds.near < bounds.far < 1e10
    assert scene.fingerprint and (scene.moves or scene.dynamic.train is scene.static.train)


class Verdicts:
    """Counts what became of inputs: read as a valid value, or refused as it should be."""

    LIMIT = 20.0

    def __init__(self, folder: Path) -> None:
        """Of files below ``folder``."""
        self.folder, self.read, self.refused = folder, 0, 0

    def of(self, reading: Callable[[], Any]) -> Any:
        """What ``reading`` returns; None, also, where it refuses."""
        try:
            with seconds(self.LIMIT):
                value = reading()
        except DevrfError as error:
            check_message(error, self.folder)
            value = None
        if isinstance(value, Scene):
            check_scene(value)
        if value is None:
            self.refused += 1
        else:
            self.read += 1
        return value


@pytest.fixture
def verdicts(tmp_path) -> Verdicts:
    """The verdicts on files below ``tmp_path``."""
    return Verdicts(tmp_path)


class Damage:
    """The strategies, for test modules: files of this folder cannot import one another."""

    json = staticmethod(edited_json)
    bytes = staticmethod(damaged_bytes)
    header = staticmethod(headed_npy)
    array = staticmethod(edited_array)


@pytest.fixture(scope="session")
def damage() -> type[Damage]:
    """The strategies."""
    return Damage
