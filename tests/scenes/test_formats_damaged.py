"""Files with one damage: each is read, or refused in one clear line.

Sixty inputs in all, or as many as DEVRF_FUZZ_INPUTS says, shared out among the layouts,
records of runs, and the catalogue of scenes.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn

from devrf.apps.fetch import OWN, catalogue
from devrf.apps.report.runs import collect
from devrf.apps.report.table import tabulate
from devrf.apps.report.text import latex, markdown, plain
from devrf.apps.report.write import csv
from devrf.data.recorded import READERS
from devrf.errors import DevrfError
from devrf.scenes.scene import Scene
from devrf.system.printed import is_shown

NUMBERS = [0, -1, 0.5, 5e-324, 1e9, 1e38, 1e300, 2**63, float("nan"), float("inf")]
TEXTS = ["", "a", "..", "/", "../../secret", "/etc/passwd", "a\0b", "\ud800", "\x1b[2J\r\n"]
CONTAINERS = [[], {}, [[]], {"": {}}, [[0] * 4] * 4, list(range(50))]
VALUES = [*NUMBERS, 10**400, *TEXTS, "x" * 5000, None, True, *CONTAINERS]


@st.composite
def edited_json(draw: DrawFn, content: Any) -> str:
    """The text of ``content`` after one to three changes, each at any place in it."""
    whole = {"": content}
    for _ in range(draw(st.integers(1, 3))):
        node: Any = whole
        key: Any = ""
        while node[key] and isinstance(node[key], list | dict) and draw(st.integers(0, 5)):
            node = node[key]
            key = draw(st.sampled_from(range(len(node)) if isinstance(node, list) else [*node]))
        if node is not whole and draw(st.integers(0, 4)) == 0:
            del node[key]
        else:
            node[key] = copy.deepcopy(draw(st.sampled_from(VALUES)))
    return json.dumps(whole[""])


@st.composite
def damaged_bytes(draw: DrawFn, data: bytes) -> bytes:
    """``data`` with a bit flipped, or bytes written over it, left out or put twice."""
    size = len(data)
    places = st.one_of(st.integers(0, size), st.integers(0, min(size, 64)))
    at, end = sorted((draw(places), draw(st.one_of(places, st.just(size)))))
    change = draw(st.sampled_from(["flip", "write", "cut", "repeat"]))
    if change == "flip" and at < size:
        return data[:at] + bytes([data[at] ^ 1 << draw(st.integers(0, 7))]) + data[at + 1 :]
    if change == "write":
        chunk = draw(st.binary(min_size=1, max_size=8))
        return data[:at] + chunk + data[at + len(chunk) :]
    return data[:at] + data[at:end] * (2 if change == "repeat" else 0) + data[end:]


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


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# The layouts, by their readers: options, and the share of all inputs in per cent.
LAYOUTS: dict[str, tuple[dict[str, Any], int]] = {
    "inward": ({"flow": "files"}, 30),
    "forward": ({"flow": "files"}, 20),
    "nerfstudio": ({}, 15),
    "nerfies": ({}, 10),
    "colmap": ({}, 5),
    "colmap_binary": ({}, 10),
    "dycheck": ({}, 5),
    "panoptic": ({"masks": "alpha"}, 5),
    "easyvolcap": ({}, 5),
    "neural_3d_video": ({}, 5),
}
INPUTS = int(os.environ.get("DEVRF_FUZZ_INPUTS", "60"))
CHANGES = ["gone", "empty", "folder", "dangling", "half", "damaged", "damaged", "damaged"]


@st.composite
def changes(draw: DrawFn, whole: Path) -> tuple[Path, bytes | str]:
    """A file of a scene, and what takes its place: other bytes, a folder, a link, nothing."""
    files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
    # Files of numbers and text are few beside images.
    file = draw(st.sampled_from([f for f in files if f.suffix != ".png"] * 3 + files))
    data, change = (whole / file).read_bytes(), draw(st.sampled_from(CHANGES))
    if change == "half":
        return file, data[: len(data) // 2]
    if change != "damaged":
        return file, b"" if change == "empty" else change
    if file.suffix == ".json" and draw(st.booleans()):
        return file, draw(edited_json(json.loads(data))).encode("utf-8", "surrogatepass")
    return file, draw(damaged_bytes(data))


def put(file: Path, what: bytes | str) -> None:
    remove(file)
    if isinstance(what, bytes):
        file.write_bytes(what)
    elif what == "folder":
        file.mkdir()
    elif what == "dangling":
        file.symlink_to(file.parent / "nowhere")


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.filterwarnings("ignore")
def test_a_damaged_file_is_read_or_refused(layout, write_layout, tmp_path):
    options, share = LAYOUTS[layout]
    whole, changed, refused = tmp_path / "whole", tmp_path / "changed", []
    write_layout(layout, whole)
    shutil.copytree(whole, changed)

    @settings(
        max_examples=max(2, INPUTS * share // 100),
        suppress_health_check=list(HealthCheck),
        deadline=20_000,  # milliseconds: nothing in a file makes a reader wait
    )
    @given(changes(whole))
    def each(change: tuple[Path, bytes | str]) -> None:
        put(changed / change[0], change[1])
        try:
            check_scene(READERS[layout.removesuffix("_binary")](changed, **options).read())
        except DevrfError as error:
            check_message(error, tmp_path)
            refused.append(str(error))
        finally:
            remove(changed / change[0])
            shutil.copyfile(whole / change[0], changed / change[0])

    each()
    # Damage that no reader notices would test nothing.
    assert len(refused) >= INPUTS * share // 1000


RECORD = {
    **{"scene": "robot", "method": "devrf", "protocol": "two_stage", "at_rest": False},
    "static": {"psnr": 33.0, "seconds": 10.0, "peak_gpu_gb": None},
    "dynamic": {"psnr": 29.0, "ssim": 0.9, "novel_times": {"psnr": 28.0, "images": 3}},
    "run": {
        **{"device": "cpu", "git": "0123456789", "overrides": ["a=1"], "seed": 0, "frames": 3},
        **{"image_size": [96, 96], "checkpoint": "ab", "date": "2026", "train_views": 4},
        "choices": {"ablation": "full", "experiment": "paper", "data": "robot"},
        "settings": {"loss.terms": [1, "x"], "schedule.seconds": 60, "priors": "none"},
    },
    **{"overrides": [], "seed": 0, "choices": {"a": "b"}, "error": "x: y", "mistake": True},
}


@pytest.mark.filterwarnings("ignore")
def test_a_damaged_record_is_reported_or_skipped(tmp_path):
    whole = json.dumps(RECORD).encode()
    for name in ("good", "changed"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.json").write_bytes(whole)
    skipped = list[str]()
    edited = st.builds(json.loads, st.just(whole)).flatmap(edited_json)

    @settings(max_examples=max(3, INPUTS * 2 // 100), suppress_health_check=list(HealthCheck))
    @given(
        st.sampled_from(["metrics.json", "failure.json"]),
        st.one_of(edited.map(str.encode), damaged_bytes(whole)),
    )
    def each(file: str, content: bytes) -> None:
        (tmp_path / "changed" / file).write_bytes(content)
        collection = collect(tmp_path)
        table = tabulate(collection)
        for text in (plain(table), markdown(table, {}), latex(table), csv(table)):
            assert all(map(is_shown, text.split("\n")))
        skipped.extend(collection.skipped)
        remove(tmp_path / "changed" / file)

    each()
    assert INPUTS < 1000 or skipped


def test_a_damaged_catalogue_is_read_or_refused(tmp_path):
    file = tmp_path / "catalogue.toml"

    @settings(max_examples=max(3, INPUTS * 10 // 100), suppress_health_check=list(HealthCheck))
    @given(damaged_bytes(OWN.read_bytes()))
    def each(content: bytes) -> None:
        file.write_bytes(content)
        try:
            catalogue(file)
        except DevrfError as error:
            assert str(error).startswith(f"fetch.catalogue: {file} cannot be read (")

    each()
