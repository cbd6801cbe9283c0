"""Damaged files for every parser: each is read, or refused in one clear line.

A thousand inputs in all, or as many as DEVRF_FUZZ_INPUTS says; the table shares them out.
"""

from __future__ import annotations

import io
import json
import os
import resource
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy
from PIL import ExifTags, Image

from devrf.data.recorded import READERS, RecordedDataModule
from devrf.scenes.flow_files import load_flow, read_flow_file
from devrf.scenes.formats.llff_poses import read_dynamic_poses, read_static_poses
from devrf.scenes.formats.nerfies import read_camera
from devrf.scenes.images import load_images
from devrf.scenes.masks import read_mask
from devrf.scenes.transforms import read_transforms

WIDTH, HEIGHT = 32, 24
Fixture = Callable[[str], Any]
# What to draw inputs from, and how one of them is written and read.
Prepared = tuple[SearchStrategy[Any], Callable[[Any], Any]]


def loaded(choice: str, root: Path, **options: Any) -> Any:
    return RecordedDataModule(READERS[choice], root, **options).load()


def written(file: Path, content: bytes | str) -> Path:
    file.unlink(missing_ok=True)
    if isinstance(content, str):
        content = content.encode("utf-8", "surrogatepass")
    file.write_bytes(content)
    return file


# --- transforms*.json


def transforms_values(fixture: Fixture) -> Prepared:
    folder = fixture("scene_folder")
    file = folder.dynamic / "transforms_train.json"
    content = json.loads(file.read_text())
    content |= {"fl_x": 40.0, "w": WIDTH, "h": HEIGHT, "k1": 0.01, "camera_model": "OPENCV"}
    content["frames"] = content["frames"][:3]
    content["frames"][2] |= {"fl_x": 41.0, "cx": 16.0}
    return fixture("damage").json(content), lambda text: read_transforms(
        written(file, text), folder.root
    )


def transforms_bytes(fixture: Fixture) -> Prepared:
    folder = fixture("scene_folder")
    file = folder.dynamic / "transforms_train.json"
    return fixture("damage").bytes(file.read_bytes()), lambda data: read_transforms(
        written(file, data), folder.root
    )


# --- arrays


def static_poses(fixture: Fixture) -> Prepared:
    folder, damage = fixture("llff_folder"), fixture("damage")
    file = folder.static / "poses_bounds.npy"

    def read(data: bytes) -> Any:
        return read_static_poses(written(file, data).parent).normalised().cameras(24, 16)

    return damaged_array(damage, np.load(file)), read


def shared_intrinsics(fixture: Fixture) -> Prepared:
    folder, damage = fixture("llff_folder"), fixture("damage")
    rows = np.load(folder.static / "poses_bounds.npy")
    np.save(folder.static / "poses_bounds.npy", np.delete(rows, [4, 9, 14], axis=1))
    file, values = folder.static / "hwf_cxcy.npy", np.array([64, 96, 80, 80, 48.0, 32.0])
    return damaged_array(damage, values), lambda data: read_static_poses(
        written(file, data).parent
    ).cameras(24, 16)


def moving_poses(fixture: Fixture) -> Prepared:
    folder, damage = fixture("llff_folder"), fixture("damage")
    files = [folder.dynamic / "poses.npy", folder.dynamic / "bds.npy"]
    whole = [file.read_bytes() for file in files]

    def of(k: int) -> SearchStrategy[Any]:
        return st.tuples(st.just(k), damaged_array(damage, np.load(files[k])))

    def read(drawn: tuple[int, bytes]) -> Any:
        for k, file in enumerate(files):
            written(file, drawn[1] if k == drawn[0] else whole[k])
        return read_dynamic_poses(folder.dynamic).cameras(24, 16)

    return st.one_of(of(0), of(1)), read


def damaged_array(damage: Any, values: np.ndarray) -> SearchStrategy[bytes]:
    return st.one_of(
        damage.bytes(npy(values)), damage.header(values), damage.array(values).map(npy)
    )


def npy(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def npz(members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    """An archive whose members need not be arrays."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return stream.getvalue()


@st.composite
def archives(draw: DrawFn, damage: Any, arrays: dict[str, np.ndarray]) -> bytes:
    """Archives with whole check sums around damaged members, or damaged as a whole."""
    members = {name: npy(values) for name, values in arrays.items()}
    compression = draw(st.sampled_from([zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED]))
    if draw(st.booleans()):
        data: bytes = draw(damage.bytes(npz(members, compression)))
        return data
    name = draw(st.sampled_from(sorted(members)))
    change = draw(st.sampled_from(["header", "bytes", "array", "gone", "other"]))
    if change == "gone":
        del members[name]
    elif change == "other":
        members[name] = draw(st.sampled_from(list(members.values()) + [b"", npz(members)]))
    elif change != "array":
        members[name] = draw(
            damage.header(arrays[name]) if change == "header" else damage.bytes(members[name])
        )
    elif arrays[name].dtype.kind == "f":
        members[name] = npy(draw(damage.array(arrays[name])))
    return npz(members, compression)


def flow(fixture: Fixture) -> Prepared:
    file = fixture("tmp_path") / "001_bwd.npz"
    arrays = {"flow": np.ones((4, 6, 2), np.float32), "mask": np.ones((4, 6), bool)}
    return archives(fixture("damage"), arrays), lambda data: read_flow_file(
        written(file, data), width=6, height=4
    )


def cached_flow(fixture: Fixture) -> Prepared:
    file = fixture("tmp_path") / "cache.npz"
    arrays = {
        "key": np.array("0" * 64),
        "vectors": np.ones((2, 4, 6, 2), np.float32),
        "valid": np.ones((2, 4, 6), bool),
    }
    return archives(fixture("damage"), arrays), lambda data: load_flow(
        written(file, data), "0" * 64, (2, 4, 6)
    )


# --- images


def images(*formats: str) -> Callable[[Fixture], Prepared]:
    def prepare(fixture: Fixture) -> Prepared:
        folder, damage = fixture("tmp_path"), fixture("damage")
        rng = np.random.default_rng(0)
        picture = Image.fromarray(rng.integers(0, 255, (HEIGHT, WIDTH, 4), dtype=np.uint8))
        picture.save(folder / "first.png")
        whole = []
        for name in formats:
            stream = io.BytesIO()
            kind, _, mode = name.partition(" ")
            picture.convert(mode).save(stream, kind)
            whole.append(stream.getvalue())
        file = folder / "second.png"
        return st.one_of([damage.bytes(data) for data in whole]), lambda data: load_images(
            [folder / "first.png", written(file, data)], 1
        )

    return prepare


def photos(fixture: Fixture) -> Prepared:
    """Photos that say that they are to be seen turned, beside one whose camera is so."""
    folder, exif = fixture("tmp_path"), Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    picture = Image.new("RGB", (HEIGHT, WIDTH), "red")
    picture.save(folder / "first.jpg", exif=exif)
    whole = (folder / "first.jpg").read_bytes()
    return fixture("damage").bytes(whole[:150]).map(lambda head: head + whole[150:]), (
        lambda data: load_images(
            [folder / "first.jpg", written(folder / "second.jpg", data)], 1, [(WIDTH, HEIGHT)] * 2
        )
    )


def masks(fixture: Fixture) -> Prepared:
    folder = fixture("tmp_path")
    noise = np.random.default_rng(0).integers(0, 2, (HEIGHT, WIDTH), dtype=np.uint8)
    whole = []
    for kind, mode in (("PNG", "L"), ("PNG", "1"), ("WEBP", "RGB")):
        stream = io.BytesIO()
        Image.fromarray(noise * np.uint8(255)).convert(mode).save(stream, kind)
        whole.append(stream.getvalue())
    return st.one_of([fixture("damage").bytes(data) for data in whole]), lambda data: read_mask(
        written(folder / "mask.png", data), (WIDTH, HEIGHT), None, "its image"
    )


# --- Nerfies


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


def nerfies_camera(fixture: Fixture) -> Prepared:
    root = nerfies_folder(fixture)
    file = root / "camera/000001.json"
    content = json.loads(file.read_text())

    def read(text: str) -> Any:
        written(file, text)
        pose, inner = read_camera(root, "000001", [0.0, 0.0, 0.0], 1.0)
        return pose, inner.lens(WIDTH, HEIGHT, root / "rgb/1x/000001.png")

    return fixture("damage").json(content), read


def nerfies_lists(fixture: Fixture) -> Prepared:
    root = nerfies_folder(fixture)
    whole = {
        name: (root / name).read_text() for name in ("dataset.json", "metadata.json", "scene.json")
    }
    inputs = st.one_of(
        [
            st.tuples(st.just(name), fixture("damage").json(json.loads(text)))
            for name, text in whole.items()
        ]
    )

    def read(drawn: tuple[str, str]) -> Any:
        for name, text in whole.items():
            written(root / name, drawn[1] if name == drawn[0] else text)
        return read_nerfies(root)

    return inputs, read


def read_nerfies(root: Path) -> Any:
    return loaded("nerfies", root, downscale=1, flow="none", bound_scale=1.5)


# --- COLMAP, DyCheck, Neural 3D Video


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


def read_colmap(root: Path) -> Any:
    return loaded("colmap", root, downscale=1, flow="none")


def colmap_text(fixture: Fixture) -> Prepared:
    root = colmap_folder(fixture)
    return one_of_files(fixture, root / "sparse/0", lambda: read_colmap(root))


def one_of_files(fixture: Fixture, folder: Path, read: Callable[[], Any]) -> Prepared:
    """What is read while one file of a folder is damaged."""
    whole = {path: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}
    inputs = [
        st.tuples(st.just(path), fixture("damage").bytes(data)) for path, data in whole.items()
    ]

    def read_damaged(drawn: tuple[Path, bytes]) -> Any:
        for path, data in whole.items():
            written(path, drawn[1] if path == drawn[0] else data)
        return read()

    return st.one_of(inputs), read_damaged


def dycheck_folder(fixture: Fixture) -> Path:
    """The scene in Nerfies' layout, with split lists."""
    root = nerfies_folder(fixture)
    ids = [f"{i:06d}" for i in range(6)]
    (root / "splits").mkdir()
    for split, part in (("train", ids[:4]), ("val", ids[4:])):
        content = {"frame_names": part, "time_ids": [int(one) for one in part]}
        (root / f"splits/{split}.json").write_text(json.dumps(content))
    return root


def dycheck_splits(fixture: Fixture) -> Prepared:
    root = dycheck_folder(fixture)
    file = root / "splits/train.json"
    content = json.loads(file.read_text())

    def read(text: str) -> Any:
        written(file, text)
        return loaded("dycheck", root, downscale=1, flow="none", bound_scale=1.5)

    return fixture("damage").json(content), read


def videos(fixture: Fixture) -> Prepared:
    root, ring = fixture("tmp_path") / "videos", fixture("ring_cameras")
    film = [np.full((HEIGHT, WIDTH, 3), 40 * t, np.uint8) for t in range(3)]
    cameras = ring(60, width=WIDTH, height=HEIGHT, angle=0.8)[torch.arange(2)]
    fixture("write_rig")(root, {"cam00.mp4": film, "cam01.mp4": film}, cameras, 2.0, 9.0)
    file = root / "cam01.mp4"
    return fixture("damage").bytes(file.read_bytes()), lambda data: loaded(
        "neural_3d_video", written(file, data).parent, downscale=1, flow="none"
    )


# --- whole scenes


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


def nerfstudio(fixture: Fixture) -> Prepared:
    root = nerfstudio_folder(fixture)
    file = root / "transforms.json"
    content = json.loads(file.read_text())
    return fixture("damage").json(content), lambda text: read_nerfstudio(written(file, text).parent)


def read_nerfstudio(root: Path) -> Any:
    return loaded("nerfstudio", root, flow="none", bound_scale=1.5)


CHANGES = "gone empty folder loop dangling pipe half rubbish damaged swapped".split()


def scene_files(
    of: Callable[[Fixture], Path], load: Callable[[Path], Any]
) -> Callable[[Fixture], Prepared]:
    """A scene in which one file, or a folder, is not what it was."""

    def prepare(fixture: Fixture) -> Prepared:
        whole = of(fixture)
        files = sorted(path.relative_to(whole) for path in whole.rglob("*"))
        changed = fixture("tmp_path") / "changed"
        shutil.copytree(whole, changed)

        @st.composite
        def inputs(draw: DrawFn) -> tuple[Path, str, Any]:
            file = draw(st.sampled_from(files))
            change = draw(st.sampled_from(CHANGES))
            if (whole / file).is_dir() and change in ("half", "damaged"):
                change = "gone"
            if change == "damaged":
                return file, change, draw(fixture("damage").bytes((whole / file).read_bytes()))
            return file, change, draw(st.sampled_from(files)) if change == "swapped" else None

        def read(drawn: tuple[Path, str, Any]) -> Any:
            change_file(changed, whole, *drawn)
            try:
                return load(changed)
            finally:
                remove(changed / drawn[0])
                copy(whole / drawn[0], changed / drawn[0])

        return inputs(), read

    return prepare


def change_file(root: Path, whole: Path, name: Path, change: str, with_what: Any) -> None:
    """Put something else in the place of the file or folder ``name``."""
    file = root / name
    remove(file)
    if change in ("empty", "rubbish"):
        file.write_bytes(b"" if change == "empty" else bytes(range(256)))
    elif change == "folder":
        file.mkdir()
    elif change in ("loop", "dangling"):
        file.symlink_to(file if change == "loop" else root / "nowhere")
    elif change == "pipe":
        os.mkfifo(file)
    elif change == "half":
        data = (whole / name).read_bytes()
        file.write_bytes(data[: len(data) // 2])
    elif change == "damaged":
        file.write_bytes(with_what)
    elif change == "swapped":
        copy(whole / with_what, file)


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def copy(source: Path, target: Path) -> None:
    (shutil.copytree if source.is_dir() else shutil.copyfile)(source, target)


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


INPUTS = int(os.environ.get("DEVRF_FUZZ_INPUTS", "1000"))


def inward_files(root: Path) -> Any:
    return loaded("inward", root, flow="files", bound_scale=1.5)


# What is read, how large a part of all inputs it gets (in 1,000), and how they are made.
PARSERS: dict[str, tuple[int, Callable[[Fixture], Prepared]]] = {
    "values of transforms.json": (160, transforms_values),
    "text of transforms.json": (80, transforms_bytes),
    "poses_bounds.npy": (110, static_poses),
    "hwf_cxcy.npy": (40, shared_intrinsics),
    "poses.npy and bds.npy": (80, moving_poses),
    "optical flow": (90, flow),
    "cached optical flow": (50, cached_flow),
    "png": (70, images("PNG RGBA", "PNG P", "PNG RGB")),
    "jpeg and webp": (50, images("JPEG RGB", "WEBP RGBA", "JPEG CMYK")),
    "photos": (20, photos),
    "masks": (20, masks),
    "camera of nerfies": (50, nerfies_camera),
    "lists of nerfies": (30, nerfies_lists),
    "nerfstudio": (30, nerfstudio),
    "COLMAP's text files": (15, colmap_text),
    "splits of DyCheck": (10, dycheck_splits),
    "videos": (5, videos),
    "files of an inward-facing scene": (12, scene_files(with_flow, inward_files)),
    "files of D-NeRF's layout": (
        12,
        scene_files(lambda fixture: fixture("single_folder"), inward_files),
    ),
    "files of a forward-facing scene": (
        12,
        scene_files(forward, lambda root: loaded("forward", root, flow="files")),
    ),
    "files of nerfstudio": (12, scene_files(nerfstudio_folder, read_nerfstudio)),
    "files of nerfies": (12, scene_files(nerfies_folder, read_nerfies)),
    "files of COLMAP": (10, scene_files(colmap_folder, read_colmap)),
}


def most_memory() -> int:
    """The most bytes that this process ever held."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


@pytest.mark.parametrize("parser", PARSERS)
@pytest.mark.filterwarnings("ignore")
def test_damaged_input_is_read_or_refused(parser, request, verdicts):
    share, prepare = PARSERS[parser]
    inputs, read = prepare(request.getfixturevalue)

    @settings(max_examples=max(1, INPUTS * share // 1000), suppress_health_check=list(HealthCheck))
    @given(inputs)
    def each(drawn: Any) -> None:
        verdicts.of(lambda: read(drawn))

    before = most_memory()
    each()
    assert most_memory() - before < 2**30
    # Damage that no parser notices would test nothing.
    assert verdicts.refused >= (verdicts.refused + verdicts.read) / 5
