"""Inputs that once ended in a traceback, a hang, a dead process, or in a scene of rubbish."""

from __future__ import annotations

import json
import os
import shutil
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pydantic import TypeAdapter

from devrf.errors import DevrfError
from devrf.scenes.files import read_json, read_numbers
from devrf.scenes.flow_files import load_flow, read_flow_file
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.formats.nerfies import NerfiesReader
from devrf.scenes.images import load_images

TRAIN = "static/transforms_train.json"


def refused(reading: Callable[[], Any]) -> str:
    """The one line, short and printable, with which an input is refused."""
    with pytest.raises(DevrfError) as caught:
        reading()
    message = str(caught.value)
    assert message.isprintable() and len(message) < 500
    return message


def frames(change: Callable[[dict[str, Any]], object]) -> Callable[[dict[str, Any]], None]:
    return lambda content: [change(frame) for frame in content["frames"]] and None


def moved(places: Callable[[list[float]], list[float]]) -> Callable[[dict[str, Any]], None]:
    """All cameras put elsewhere."""

    def change(frame: dict[str, Any]) -> None:
        rows = frame["transform_matrix"]
        for row, value in zip(rows, places([row[3] for row in rows[:3]]), strict=False):
            row[3] = value

    return frames(change)


DEEP: list[Any] = []
for _ in range(100):
    DEEP = [DEEP]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        # tan(0) in the denominator.
        pytest.param(lambda c: c.update(camera_angle_x=5e-324), "camera_angle_x", id="no angle"),
        # A focal length that is infinite in single precision, or next to nothing.
        pytest.param(lambda c: c.update(fl_x=1e38), "cannot be one of", id="endless focal"),
        pytest.param(lambda c: c.update(fl_x=1e-30), "cannot be one of", id="no focal"),
        pytest.param(lambda c: c.update(fl_x=9, cx=1e30), "cannot be one of", id="far middle"),
        # Squares overflow, so the box's corners were NaN.
        pytest.param(moved(lambda p: [v * 1e30 for v in p]), "farther than", id="far cameras"),
        # Corners that are equal in single precision.
        pytest.param(
            moved(lambda p: [v * 1e-3 + 1e4 for v in p]), "data.box", id="far small scene"
        ),
        pytest.param(moved(lambda p: [v * 1e-30 for v in p]), "data.box", id="tiny scene"),
        # Longer than a terminal, or deeper than the stack, once shown in the message.
        pytest.param(lambda c: c.update(camera_model="x" * 10**5), "xxx", id="long name"),
        pytest.param(lambda c: c.update(fl_x=DEEP), "not [[[...]]]", id="deep value"),
        pytest.param(
            frames(lambda f: f.update(file_path="x" * 10**5)), "no such image", id="long path"
        ),
        pytest.param(
            frames(lambda f: f.update(file_path="\x1b[2J\ud800")), "not valid JSON", id="unwritable"
        ),
        pytest.param(
            frames(lambda f: f.update(file_path="\x1b[2J")), "\\x1b[2J", id="terminal commands"
        ),
    ],
)
def test_values_of_a_transforms_file(scene_folder, change, said):
    scene_folder.edit(scene_folder.root / TRAIN, change)
    assert said in refused(lambda: BlenderReader(scene_folder.root).read())


def test_a_byte_order_mark_is_no_mistake(tmp_path):
    file = tmp_path / "a.json"
    file.write_bytes(b'\xef\xbb\xbf{"a": 1, "a": 2}')
    assert read_json(file, TypeAdapter(dict[str, int]), "it is tested") == {"a": 2}


ROWS = "static/poses_bounds.npy"


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ((slice(None), 15), 1e-300, "farther than"),
        ((2, 3), 1e30, "farther than"),
        ((2, 14), 1e30, "focal length"),
        ((2, 14), 1e-30, "focal length"),
        # Not far enough to overflow, too far for a box in normalised device coordinates.
        ((2, 3), 1e8, "too far from the others"),
    ],
)
def test_values_of_llff_poses(llff_folder, place, value, said):
    rows = np.load(llff_folder.root / ROWS)
    rows[place] = value
    llff_folder.save(ROWS, rows)
    assert said in refused(lambda: LlffReader(llff_folder.root).read())


def header(text: str, data: bytes = bytes(200)) -> bytes:
    line = text.encode() + b"\n"
    return b"\x93NUMPY\1\0" + len(line).to_bytes(2, "little") + line + data


HEADERS = {
    # numpy divides by the width while it maps the file: the process died of it.
    "values of no width": "{'descr': '|S0', 'fortran_order': False, 'shape': (3, 5)}",
    # What numpy's second attempt at parsing raises is none of its documented errors.
    "unfinished": "{'descr': '<f8', ",
    "indented": "  {'descr': '<f8'\n\t}\n 1",
    "too deep": "(" * 190,
    "larger than an integer": f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({10**30},)}}",
    "negative": "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 17)}",
    "a petabyte": f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({10**14}, 4)}}",
}


@pytest.mark.parametrize("text", HEADERS.values(), ids=HEADERS)
def test_headers_of_arrays(tmp_path, text):
    npy, npz, cache = tmp_path / "a.npy", tmp_path / "a.npz", tmp_path / "cache.npz"
    npy.write_bytes(header(text))
    for path, names in ((npz, ("flow", "mask")), (cache, ("key", "vectors", "valid"))):
        with zipfile.ZipFile(path, "w") as archive:
            for name in names:
                archive.writestr(f"{name}.npy", header(text))
    assert str(npy) in refused(lambda: read_numbers(npy, "cameras"))
    assert str(npz) in refused(lambda: read_flow_file(npz, width=6, height=4))
    assert load_flow(cache, "0" * 64, (2, 4, 6)) is None


@pytest.fixture
def arrays() -> dict[str, np.ndarray]:
    return {"flow": np.ones((4, 6, 2), np.float32), "mask": np.ones((4, 6), bool)}


def test_a_member_that_goes_by_the_name_of_an_array(tmp_path, arrays):
    """numpy prefers ``flow`` to ``flow.npy``, whose header alone had been looked at."""
    path = tmp_path / "f.npz"
    np.savez(path, **arrays)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("flow", header(HEADERS["a petabyte"]))
    assert read_flow_file(path, width=6, height=4)[1].all()


def test_two_members_of_one_name(tmp_path, arrays):
    path = tmp_path / "f.npz"
    np.savez(path, **arrays)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("mask.npy", b"")
    assert 'more than one array "mask"' in refused(lambda: read_flow_file(path, 6, 4))


def test_a_compression_that_numpy_does_not_write(tmp_path):
    """LZMA takes as much memory as its own header asks for."""
    path = tmp_path / "f.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("flow.npy", b"")
    assert "compressed in a way" in refused(lambda: read_flow_file(path, 6, 4))


@pytest.mark.parametrize("value", [1e30, 1e300, 11.0])
def test_vectors_longer_than_the_image_are_not_trusted(tmp_path, arrays, value):
    vectors = arrays["flow"].astype(np.float64)
    vectors[1, 2, 0] = -value
    np.savez(tmp_path / "f.npz", flow=vectors, mask=arrays["mask"])
    read, valid = read_flow_file(tmp_path / "f.npz", width=6, height=4)
    assert np.argwhere(~valid).tolist() == [[1, 2]] and not read[1, 2].any()


@pytest.mark.parametrize("frame", ["001", "002"])
def test_a_pipe_in_the_place_of_a_flow_file(llff_folder, frame):
    """Opening it waits for ever for somebody who writes."""
    for other in ("001", "002"):
        llff_folder.flow(1, other, 0.5)
    path = llff_folder.dynamic / f"view1/images_4_flow/{frame}_bwd.npz"
    path.unlink()
    os.mkfifo(path)
    flow = LlffReader(llff_folder.root).read().dynamic.train.flow
    assert flow is not None and int(flow.valid.flatten(1).any(dim=1).sum()) == 1


@pytest.mark.parametrize("kind", ["BMP", "GIF", "TIFF", "EPS", "PDF"])
def test_other_formats_under_the_name_of_a_png(tmp_path, kind):
    """Pillow would start Ghostscript for some of them."""
    path = tmp_path / "a.png"
    Image.new("RGB", (16, 16)).save(path, kind)
    assert f"{path}: not a readable image" in refused(lambda: load_images([path], 1))


def test_many_ids_are_looked_up_at_once(tmp_path):
    """Once the square of their number: minutes."""
    (tmp_path / "rgb/1x").mkdir(parents=True)
    ids = [f"{i:06d}" for i in range(40_000)]
    for name, content in {
        "scene": {"center": [0, 0, 0], "scale": 1, "near": 0.5, "far": 9},
        "dataset": {"train_ids": ids[:-100], "val_ids": ids[-100:]},
    }.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    start = time.perf_counter()
    said = refused(lambda: NerfiesReader(tmp_path, downscale=1).read())
    assert "40000 of the 40000 images in dataset.json are absent" in said
    assert time.perf_counter() - start < 10


def test_a_home_that_is_not_there():
    assert refused(lambda: BlenderReader("~nobody-of-that-name/x").read()).startswith("data.root: ")


def test_a_folder_that_may_not_be_listed(llff_folder, monkeypatch):
    closed, listed = llff_folder.static / "images_4", Path.iterdir

    def iterdir(path: Path) -> Any:
        if path == closed:
            raise PermissionError(13, "Permission denied")
        return listed(path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    assert f"{closed}: cannot be listed (Permission denied)" in refused(
        lambda: LlffReader(llff_folder.root).read()
    )


def test_more_than_fits_into_memory(scene_folder, monkeypatch):
    shutil.rmtree(scene_folder.static)
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(total=2**10))
    images = sorted((scene_folder.dynamic / "train").iterdir())
    assert "6 images of 32x24 px take 0.0 GiB" in refused(lambda: load_images(images, 1))
