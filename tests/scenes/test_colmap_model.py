"""COLMAP's sparse models: text and binary say the same, and damage is named."""

from __future__ import annotations

import struct

import pytest
import torch

from devrf.errors import DevrfError
from devrf.scenes.colmap_model import model_folder, read_model

HALF = 0.5**0.5
# Camera 7 at (1, 2, 3), turned by 90 degrees about its viewing axis z; two points.
CAMERA = (7, 4, 64, 48, (50.0, 51.0, 32.0, 24.0, 0.1, 0.01, 0.001, 0.002))
IMAGES = [
    ("b.png", (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), [(5.0, 6.0, 11), (1.0, 1.0, -1)]),
    ("a b.png", (HALF, 0.0, 0.0, HALF), (2.0, -1.0, -3.0), [(5.0, 6.0, 4), (7.0, 8.0, 11)]),
]
POINTS = {11: (1.0, 2.0, 8.0), 4: (0.0, 0.0, 5.0)}


def write_text(folder):
    folder.mkdir(parents=True)
    number, _, width, height, values = CAMERA
    line = " ".join(map(str, (number, "OPENCV", width, height, *values)))
    (folder / "cameras.txt").write_text(f"# comment\n{line}\n")
    lines = ["# comment"]
    for k, (name, turn, move, seen) in enumerate(IMAGES, 1):
        lines.append(" ".join(map(str, (k, *turn, *move, number, name))))
        lines.append(" ".join(f"{x} {y} {p}" for x, y, p in seen))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    points = [f"{n} {x} {y} {z} 9 9 9 0.5 1 0 2 1" for n, (x, y, z) in POINTS.items()]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")


def write_binary(folder):
    folder.mkdir(parents=True)
    *head, values = CAMERA
    data = struct.pack("<QiiQQ8d", 1, *head, *values)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(IMAGES))
    for k, (name, turn, move, seen) in enumerate(IMAGES, 1):
        data += struct.pack("<i7di", k, *turn, *move, CAMERA[0]) + name.encode() + b"\0"
        data += struct.pack("<Q", len(seen)) + b"".join(struct.pack("<ddq", *s) for s in seen)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(POINTS))
    for number, place in POINTS.items():
        data += struct.pack("<Q3d3Bd", number, *place, 9, 9, 9, 0.5)
        data += struct.pack("<Q4i", 2, 1, 0, 2, 1)
    (folder / "points3D.bin").write_bytes(data)


@pytest.fixture(params=[write_text, write_binary], ids=["text", "binary"])
def scene(request, tmp_path):
    request.param(tmp_path / "sparse" / "0")
    return tmp_path


def test_cameras_images_and_points(scene):
    folder = model_folder(scene)
    assert folder == scene / "sparse" / "0"
    model = read_model(folder)
    assert [one.name for one in model.images] == ["a b.png", "b.png"]
    keys = {"fl_x": 50, "fl_y": 51, "cx": 32, "cy": 24, "w": 64, "h": 48}
    keys |= {"k1": 0.1, "k2": 0.01, "p1": 0.001, "p2": 0.002}
    assert model.cameras[7].keys == keys
    turned, straight = model.poses
    # World to camera (x, y, z) → (−y, x, z) + t, so the camera is at (1, 2, 3); its y is flipped.
    assert torch.allclose(turned[:, 3], torch.tensor([1.0, 2.0, 3.0]).double())
    expected = torch.tensor([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]]).double()
    assert torch.allclose(turned[:, :3], expected, atol=1e-12)
    assert torch.allclose(straight[:, :3], torch.diag(torch.tensor([1.0, -1, -1])).double())
    assert model.depths(0).tolist() == pytest.approx([5 - 3, 8 - 3])
    assert model.depths(1).tolist() == [8.0]


def test_a_file_that_breaks_off_is_named(tmp_path):
    write_binary(tmp_path / "model")
    file = tmp_path / "model" / "images.bin"
    whole = file.read_bytes()
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(DevrfError, match=rf"images\.bin: ends after {length} bytes, in the"):
            read_model(tmp_path / "model")


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("cameras.txt", "7 OPENCV_FISHEYE 64 48 1 2 3 4 5 6 7 8", "OPENCV_FISHEYE is not support"),
        ("cameras.txt", "7 PINHOLE 64 48 50 32", "model PINHOLE has 2 parameters, expected 4"),
        ("cameras.txt", "8 PINHOLE 64 48 50 50 32 24", "has camera 7, which cameras.txt does not"),
        ("cameras.txt", "7 PINHOLE wide 48 50 50 32 24", "is not one of COLMAP's"),
        ("images.txt", "1 1 0 0 0 0 0 0 7\n", "is not one of COLMAP's"),
        ("images.txt", "# nothing\n", "lists no image"),
        ("cameras.txt", f"7 PINHOLE {10**40} 48 50 50 32 24", "a camera has size"),
        ("points3D.txt", f"{2**63} 0 0 0 9 9 9 0.5", "is not one of COLMAP's"),
    ],
)
def test_wrong_text_is_named(tmp_path, file, text, expected):
    write_text(tmp_path / "model")
    (tmp_path / "model" / file).write_text(text)
    with pytest.raises(DevrfError, match=expected.replace(".", r"\.")):
        read_model(tmp_path / "model")


def test_a_pose_that_turns_nothing_is_named(tmp_path):
    write_text(tmp_path / "model")
    (tmp_path / "model" / "images.txt").write_text("1 0 0 0 0 0 0 0 7 a.png\n\n")
    with pytest.raises(DevrfError, match=r"pose of image a\.png is no rigid transform"):
        _ = read_model(tmp_path / "model").poses
