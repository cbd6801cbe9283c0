"""Layouts are told by their files; where none fits, one line says what each lacks."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from devrf.data.recorded import InwardFacingDataModule
from devrf.errors import DevrfError
from devrf.scenes import formats
from devrf.scenes.formats import check_choice, recognise

PARTS = ("cameras", "images", "points3D")
MODEL = [f"sparse/0/{part}.bin" for part in PARTS]
LAYOUTS = {
    "DeVRF": ("inward", ["static/transforms_train.json", "dynamic_4views/transforms_train.json"]),
    "D-NeRF and NeRF-synthetic": ("inward", ["transforms_train.json", "transforms_test.json"]),
    "LLFF": ("forward", ["poses_bounds.npy"]),
    "DeVRF, forward-facing": ("forward", ["static/poses_bounds.npy", "dynamic_4views/poses.npy"]),
    "nerfstudio": ("nerfstudio", ["transforms.json"]),
    "two captures of nerfstudio": ("nerfstudio", ["static/transforms.json"]),
    "Nerfies": ("nerfies", ["dataset.json", "metadata.json", "scene.json"]),
    "DyCheck": ("dycheck", ["splits/train.json", "splits/val.json", "dataset.json", "scene.json"]),
    "Dynamic 3D Gaussians": ("panoptic", ["train_meta.json", "test_meta.json", "ims/0/0.jpg"]),
    "EasyVolcap": ("easyvolcap", ["intri.yml", "extri.yml", "images/00/000000.jpg"]),
    "Neural 3D Video": ("neural_3d_video", ["poses_bounds.npy", "cam00.mp4", "cam01.mp4"]),
    "Neural 3D Video, of a camera": ("neural_3d_video", ["poses_bounds.npy", "cam00.MOV"]),
    "Neural 3D Video, frames": ("neural_3d_video", ["poses_bounds.npy", "cam00/0.png"]),
    "Neural 3D Video, images": ("neural_3d_video", ["poses_bounds.npy", "cam00/images/0.png"]),
    "LLFF beside notes": ("forward", ["poses_bounds.npy", "cam00.txt", "camera.mp4"]),
    "COLMAP": ("colmap", [*MODEL, "images/0.jpg"]),
    "COLMAP, one folder less": ("colmap", [f"sparse/{part}.txt" for part in PARTS]),
    "COLMAP's second model": ("colmap", [f"sparse/1/{part}.bin" for part in PARTS]),
    "COLMAP, as nerfstudio leaves it": ("colmap", [f"colmap/{name}" for name in MODEL]),
    # mip-NeRF 360 has both; a video says its times, a model of COLMAP does not.
    "COLMAP beside LLFF": ("colmap", ["poses_bounds.npy", *MODEL]),
    "NR-NeRF": ("forward", ["precomputed.json", "images/image000001.png"]),
    "NR-NeRF, with COLMAP's files": ("forward", ["poses_bounds.npy", "precomputed.json", *MODEL]),
    # nerfstudio's converters leave COLMAP's other files beside their own.
    "nerfstudio beside LLFF": ("nerfstudio", ["transforms.json", "poses_bounds.npy"]),
}


def touch(root: Path, files: list[str]) -> Path:
    for name in files:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


@pytest.mark.parametrize("name", LAYOUTS)
def test_known_layouts(tmp_path: Path, name: str) -> None:
    choice, files = LAYOUTS[name]
    assert recognise(touch(tmp_path, files)).choice == choice


def test_what_each_layout_lacks_is_said_in_one_line(tmp_path: Path) -> None:
    root = touch(tmp_path / "scene", ["scene.json", "notes.txt"])
    with pytest.raises(DevrfError) as caught:
        recognise(root)
    line = str(caught.value)
    assert line.startswith(f"{root}: no known layout") and len(line.splitlines()) == 1
    for part in (
        *("dataset.json", "static/transforms_train.json", " transforms_train.json", "intri.yml"),
        *(" transforms.json", "sparse/0/cameras.bin", " poses_bounds.npy"),
        "set data.root to the scene's folder",
    ):
        assert part in line
    assert "mp4" not in line  # what lacks more than another is left out


def test_an_incomplete_model_is_left_alone_and_said(tmp_path: Path) -> None:
    layout = recognise(touch(tmp_path, ["poses_bounds.npy", *MODEL[:2]]))
    assert layout.choice == "forward"
    assert "its sparse/ is incomplete, no sparse/0/points3D.bin: left alone" in layout.remark


@pytest.mark.parametrize(
    ("files", "missing"),
    [
        ([*MODEL[:2], "sparse/0/points3D.ply", "images/0.jpg"], "sparse/0/points3D.bin"),
        (["sparse/0/images.txt", "sparse/0/points3D.txt"], "sparse/0/cameras.txt"),
        # Parts of two models are none.
        ([*MODEL[:2], "sparse/1/points3D.bin"], "sparse/0/points3D.bin"),
        (["colmap/sparse/0/cameras.bin", "colmap/sparse/0/points3D.bin"], "sparse/0/images.bin"),
    ],
)
def test_the_missing_file_of_a_model_is_named(tmp_path: Path, files, missing) -> None:
    touch(tmp_path, files)
    with pytest.raises(DevrfError, match=f"{missing}: no such file; a COLMAP model is ") as caught:
        recognise(tmp_path)
    assert len(str(caught.value).splitlines()) == 1
    touch(tmp_path, ["transforms.json"])
    with pytest.raises(DevrfError, match=f"{missing}: no such file"):
        check_choice(tmp_path, "colmap")
    assert recognise(tmp_path).choice == "nerfstudio"


@pytest.mark.parametrize(
    ("files", "root", "typed"),
    [
        (["lego/transforms_train.json", "notes/readme.txt"], "", "data.root={}/lego"),
        ([*MODEL, "images/0.jpg"], "images", "data.root={}"),
        (["transforms.json"], "transforms.json", "data.root={}"),
        (["cup/images/0.png"], "cup", "capture.static={}/cup/images capture.into=scenes/cup"),
        (["a.mp4", "b.mov"], "", "a.mp4 'capture.views=[{}/b.mov]' capture.into=scenes/a"),
        (["walk.MP4"], "walk.MP4", "capture.static={}/walk.MP4 capture.into=scenes/walk"),
    ],
)
def test_the_line_says_what_to_type(tmp_path: Path, files, root, typed) -> None:
    touch(tmp_path, files)
    with pytest.raises(DevrfError, match=re.escape(typed.format(tmp_path))) as caught:
        recognise(tmp_path / root)
    assert len(str(caught.value).splitlines()) == 1


def test_a_wrong_reader_is_answered_with_the_right_one(tmp_path: Path) -> None:
    touch(tmp_path, MODEL)
    with pytest.raises(DevrfError, match="the files of COLMAP, .*; write data=colmap, or leave"):
        _ = InwardFacingDataModule(tmp_path).scene

    with pytest.raises(DevrfError, match="nowhere: no such folder"):
        recognise(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("IMG_1.HEIC", "; .heic files are there, which are not read: convert them to PNG"),
        ("images/1.avif", "; .avif files are there, which are not read: convert them to PNG"),
        ("scene.zip", "/scene.zip: is an archive; unpack it, and set data.root to its folder"),
    ],
)
def test_a_folder_of_what_is_not_read(tmp_path, file, said):
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).touch()
    with pytest.raises(DevrfError) as caught:
        recognise(tmp_path)
    assert str(caught.value).endswith(said)


def test_many_folders_in_one_are_looked_at_in_seconds(tmp_path, monkeypatch):
    """Installed packages, which take longer than a folder, are looked through once."""
    for number in range(20):
        (tmp_path / str(number)).mkdir()
    asked = []
    monkeypatch.setattr(formats, "entry_points", lambda group: asked.append(group) or [])
    formats._installed.cache_clear()
    with pytest.raises(DevrfError, match="no known layout"):
        recognise(tmp_path)
    formats._installed.cache_clear()
    assert asked == ["devrf.layouts"]
