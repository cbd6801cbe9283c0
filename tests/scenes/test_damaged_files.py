"""Scenes with one damaged file: each is read, or refused in one clear line.

A hundred inputs in all, or as many as DEVRF_FUZZ_INPUTS says, shared out among the layouts.
"""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy
from PIL import Image

from devrf.data.recorded import READERS, RecordedDataModule
from devrf.errors import DevrfError
from devrf.scenes.scene import Scene

WIDTH, HEIGHT = 32, 24
Fixture = Callable[[str], Any]

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


def nerfies_folder(fixture: Fixture) -> Path:
    """The scene of one folder with a moving camera, in Nerfies' layout."""
    source, ring = fixture("single_folder"), fixture("ring_cameras")
    root: Path = fixture("tmp_path") / "nerfies"
    ids = [f"{i:06d}" for i in range(6)]
    shutil.copytree(source / "train", root / "rgb" / "1x")
    (root / "camera").mkdir()
    poses = ring(6, width=WIDTH, height=HEIGHT, angle=0.8).camera_to_world
    for i, (item, pose) in enumerate(zip(ids, poses, strict=True)):
        (root / f"rgb/1x/r_{i:03d}.png").rename(root / f"rgb/1x/{item}.png")
        axes = pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0])
        (root / f"camera/{item}.json").write_text(
            json.dumps(
                {
                    "orientation": axes.T.tolist(),
                    "position": pose[:, 3].tolist(),
                    "focal_length": 38.0,
                    "pixel_aspect_ratio": 1.0,
                    "skew": 0.0,
                    "principal_point": [16.0, 12.0],
                    "image_size": [WIDTH, HEIGHT],
                    "radial_distortion": [0.0, 0.0, 0.0],
                    "tangential_distortion": [0.0, 0.0],
                }
            )
        )
    for name, content in {
        "scene": {"center": [0.0, 0, 0], "scale": 1.0, "near": 0.5, "far": 9.0},
        "metadata": {item: {"warp_id": i, "camera_id": 0} for i, item in enumerate(ids)},
        "dataset": {"count": 6, "ids": ids, "train_ids": ids[:4], "val_ids": ids[4:]},
    }.items():
        (root / f"{name}.json").write_text(json.dumps(content))
    return root


def colmap_folder(fixture: Fixture) -> Path:
    """Six posed images of one folder."""
    source, ring = fixture("single_folder"), fixture("ring_cameras")
    root: Path = fixture("tmp_path") / "colmap"
    shutil.copytree(source / "train", root / "images")
    cameras = ring(6, width=WIDTH, height=HEIGHT, angle=0.8)
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    names = [f"r_{k:03d}.png" for k in range(6)]
    fixture("write_sparse")(root / "sparse/0", cameras, names, points)
    return root


def dycheck_folder(fixture: Fixture) -> Path:
    """The scene in Nerfies' layout, with split lists."""
    root = nerfies_folder(fixture)
    ids = [f"{i:06d}" for i in range(6)]
    (root / "splits").mkdir()
    for split, part in (("train", ids[:4]), ("val", ids[4:])):
        content = {"frame_names": part, "time_ids": [int(one) for one in part]}
        (root / f"splits/{split}.json").write_text(json.dumps(content))
    return root


def videos_folder(fixture: Fixture) -> Path:
    """Two cameras of three frames."""
    root, ring = fixture("tmp_path") / "videos", fixture("ring_cameras")
    film = [np.full((HEIGHT, WIDTH, 3), 40 * t, np.uint8) for t in range(3)]
    cameras = ring(60, width=WIDTH, height=HEIGHT, angle=0.8)[torch.arange(2)]
    fixture("write_rig")(root, {"cam00.mp4": film, "cam01.mp4": film}, cameras, 2.0, 9.0)
    return Path(root)


def nerfstudio_folder(fixture: Fixture) -> Path:
    root: Path = fixture("single_folder")
    content = json.loads((root / "transforms_train.json").read_text())
    del content["camera_angle_x"]
    content |= {"fl_x": 38.0, "fl_y": 38.0, "w": WIDTH, "h": HEIGHT, "k1": 0.01}
    content |= {"train_filenames": [f["file_path"] for f in content["frames"][:5]]}
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[: HEIGHT // 4] = 0
    Image.fromarray(mask).save(root / "mask.png")
    for frame in content["frames"]:
        frame["mask_path"] = "mask.png"
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def with_flow(fixture: Fixture) -> Path:
    folder = fixture("scene_folder")
    (folder.dynamic / "train_flow").mkdir()
    for k in range(2, 6):
        np.savez(
            folder.dynamic / f"train_flow/{k:03d}_bwd.npz",
            flow=np.ones((HEIGHT, WIDTH, 2), np.float32),
            mask=np.ones((HEIGHT, WIDTH), bool),
        )
    root: Path = folder.root
    return root


def forward(fixture: Fixture) -> Path:
    folder = fixture("llff_folder")
    for frame in ("001", "002"):
        folder.flow(1, frame, 0.5)
    root: Path = folder.root
    return root


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# The layouts: a whole scene, its reader and options, and the share of all inputs that it gets.
LAYOUTS: dict[str, tuple[Callable[[Fixture], Path], str, dict[str, Any], int]] = {
    "DeVRF": (with_flow, "inward", {"flow": "files"}, 25),
    "D-NeRF": (lambda fixture: fixture("single_folder"), "inward", {}, 10),
    "LLFF": (forward, "forward", {"flow": "files"}, 20),
    "nerfstudio": (nerfstudio_folder, "nerfstudio", {}, 15),
    "Nerfies": (nerfies_folder, "nerfies", {"downscale": 1}, 10),
    "COLMAP": (colmap_folder, "colmap", {"downscale": 1}, 10),
    "DyCheck": (dycheck_folder, "dycheck", {"downscale": 1}, 5),
    "Neural 3D Video": (videos_folder, "neural_3d_video", {"downscale": 1}, 5),
}
INPUTS = int(os.environ.get("DEVRF_FUZZ_INPUTS", "100"))
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
    if file.suffix == ".npy" and draw(st.booleans()):
        stream = io.BytesIO()
        np.save(stream, draw(edited_array(np.load(whole / file))))
        return file, stream.getvalue()
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
def test_a_damaged_file_is_read_or_refused(layout, request, tmp_path):
    make, choice, options, share = LAYOUTS[layout]
    whole, changed, refused = make(request.getfixturevalue), tmp_path / "changed", []
    shutil.copytree(whole, changed)

    @settings(max_examples=max(1, INPUTS * share // 100), suppress_health_check=list(HealthCheck))
    @given(changes(whole))
    def each(change: tuple[Path, bytes | str]) -> None:
        put(changed / change[0], change[1])
        try:
            module = RecordedDataModule(READERS[choice], changed, **{"flow": "none", **options})
            check_scene(module.load())
        except DevrfError as error:
            check_message(error, tmp_path)
            refused.append(str(error))
        finally:
            remove(changed / change[0])
            shutil.copyfile(whole / change[0], changed / change[0])

    each()
    # Damage that no reader notices would test nothing.
    assert len(refused) >= INPUTS * share // 1000
