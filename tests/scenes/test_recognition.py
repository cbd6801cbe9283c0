"""Layouts are told by their files; where none fits, one line says what each lacks."""

from __future__ import annotations

from pathlib import Path

import pytest

from devrf.errors import DevrfError
from devrf.scenes.formats import recognise

LAYOUTS = {
    "DeVRF": ("inward", ["static/transforms_train.json", "dynamic_4views/transforms_train.json"]),
    "D-NeRF and NeRF-synthetic": ("inward", ["transforms_train.json", "transforms_test.json"]),
    "LLFF": ("forward", ["poses_bounds.npy"]),
    "DeVRF, forward-facing": ("forward", ["static/poses_bounds.npy", "dynamic_4views/poses.npy"]),
    "nerfstudio": ("nerfstudio", ["transforms.json"]),
    "two captures of nerfstudio": ("nerfstudio", ["static/transforms.json"]),
    "Nerfies": ("nerfies", ["dataset.json", "metadata.json", "scene.json"]),
    "DyCheck": ("dycheck", ["splits/train.json", "splits/val.json", "dataset.json", "scene.json"]),
    "Neural 3D Video": ("neural_3d_video", ["poses_bounds.npy", "cam00.mp4", "cam01.mp4"]),
    "COLMAP": ("colmap", ["sparse/0/cameras.bin", "sparse/0/images.bin", "images/0.jpg"]),
    "COLMAP, one folder less": ("colmap", ["sparse/cameras.txt", "sparse/images.txt"]),
    # mip-NeRF 360 has both; a video says its times, a model of COLMAP does not.
    "COLMAP beside LLFF": ("colmap", ["poses_bounds.npy", "sparse/0/cameras.bin"]),
    "NR-NeRF": ("forward", ["poses_bounds.npy", "precomputed.json", "sparse/0/cameras.bin"]),
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
        "Nerfies: no dataset.json;",
        "DeVRF: no static/transforms_train.json",
        "D-NeRF, NeRF-synthetic: no transforms_train.json",
        "instant-ngp: no transforms.json",
        "COLMAP: no sparse/**/cameras.*",
        "LLFF: no poses_bounds.npy",
        "set data.root to the scene's folder",
    ):
        assert part in line
    assert "mp4" not in line  # what lacks more than another is left out


def test_a_folder_of_scenes_is_told_from_a_scene(tmp_path: Path) -> None:
    touch(tmp_path, ["lego/transforms_train.json", "notes/readme.txt"])
    with pytest.raises(DevrfError, match="lego/ in it is a scene: give data.root that folder"):
        recognise(tmp_path)
    with pytest.raises(DevrfError, match="nowhere: no such folder"):
        recognise(tmp_path / "nowhere")
