"""COLMAP's sparse models and their images as a scene: at rest, or beside fixed views."""

from __future__ import annotations

import importlib
import logging
import os
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.data.kind import faces_forward
from devrf.errors import DevrfError
from devrf.geometry.cameras import Distortion
from devrf.geometry.offset import added
from devrf.scenes.formats.colmap import ColmapReader
from devrf.scenes.lens import Lens
from devrf.scenes.sparse_model import normalised, read_model, scene_model
from devrf.system.memory import own_memory
from layouts import points_in, write_sparse

# Not square, the principal point off the middle.
WIDTH, HEIGHT, COUNT = 80, 60, 17
LENS = Lens((88.0, 84.0), (42.0, 28.0), Distortion((-0.3, 0.1, 0.0, 0.0), (0.006, -0.008)))
OPENCV = (88.0, 84.0, 42.0, 28.0, -0.3, 0.1, 0.006, -0.008)
# In the order of their names, which is not that of the ring; names may hold folders.
NAMES = [f"round/img_{(5 * k) % COUNT:02d}.png" for k in range(COUNT)]
# The middles of the balls that the pictures show, and others around them.
BALLS = torch.tensor([[1.2, 0.1, 0.45], [-0.6, 1.0, 0.0], [0.1, -1.1, -0.45]])
POINTS = torch.cat([BALLS, 2 * torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 1])


@pytest.fixture
def message_of(refusal) -> Callable[..., str]:
    return partial(refusal, ColmapReader, downscale=1)


@pytest.fixture
def folder(tmp_path, ring_cameras, picture) -> Path:
    """A ring of pictures of the balls, taken through a lens with distortion."""
    root = tmp_path / "balls"
    ring = ring_cameras(COUNT, width=WIDTH, height=HEIGHT, angle=0.9)
    (root / "images/round").mkdir(parents=True)
    for name, pose in zip(NAMES, ring.camera_to_world, strict=True):
        iio.imwrite(root / "images" / name, picture(pose, LENS, WIDTH, HEIGHT))
    write_sparse(root / "sparse/0", ring, NAMES, POINTS, "OPENCV", OPENCV)
    return root


def test_points_fall_on_the_pixels_that_show_them(folder, balls_are_where_they_project):
    scene = ColmapReader(folder, downscale=1).read()
    model = read_model(folder / "sparse/0")
    balls = points_in(normalised(model)[0], model)[:3].float()
    for views in (scene.static.train, scene.static.test):
        balls_are_where_they_project(views, balls)


def test_one_image_has_one_pose(folder, ring_cameras, message_of):
    """A name with another suffix means the file that is there, whose pose is another."""
    ring = ring_cameras(COUNT, width=WIDTH, height=HEIGHT, angle=0.9)
    names = [*NAMES[:-1], NAMES[0].replace(".png", ".jpg")]
    shutil.rmtree(folder / "sparse")
    write_sparse(folder / "sparse/0", ring, names, POINTS, "OPENCV", OPENCV)
    assert "lists 'round/img_00.png' twice" in message_of(folder)


def test_every_eighth_image_is_held_out_and_nothing_moves(folder, message_of):
    scene = ColmapReader(folder, downscale=1).read()
    assert [name[-6:-4] for name in scene.static.test.names] == ["00", "08", "16"]
    assert len(scene.static.train) == 14 and scene.name == "balls"
    assert not scene.moves and scene.dynamic.train is scene.static.train
    assert len(ColmapReader(folder, downscale=1, holdout=3).read().static.test) == 6
    assert "data.frames: 2 was asked for" in message_of(folder, frames=2)


def test_the_world_is_upright_around_what_is_looked_at(folder):
    """The ring is level, at a distance of 4 already: turned about z at most."""
    scene = ColmapReader(folder, downscale=1).read()
    assert scene.kind == "inward" and scene.space.is_linear  # balls that are cut out
    cameras = scene.static.train.cameras
    torch.testing.assert_close(cameras.positions.norm(dim=1), torch.full((14,), 4.0))
    torch.testing.assert_close(cameras.positions[:, 2], torch.full((14,), 1.2), atol=1e-4, rtol=0)
    low, high = np.array(scene.bounds.box.low), np.array(scene.bounds.box.high)
    assert (low < -0.9).all() and (high > 0.9).all() and (high - low < 3.2).all()


def opaque(folder: Path) -> None:
    for path in (folder / "images/round").iterdir():
        iio.imwrite(path, iio.imread(path)[..., :3])


def test_a_model_far_from_the_origin_is_read_as_the_same_near_it(folder, ring_cameras):
    near = ColmapReader(folder, downscale=1).read()
    far = torch.tensor([500_000.0, 5_600_000.0, 200.0], dtype=torch.float64)
    ring = ring_cameras(COUNT, width=WIDTH, height=HEIGHT, angle=0.9)
    poses = added(ring.camera_to_world, tuple(far.tolist()))
    shutil.rmtree(folder / "sparse/0")
    cameras = replace(ring, camera_to_world=poses)
    write_sparse(folder / "sparse/0", cameras, NAMES, POINTS.double() + far, "OPENCV", OPENCV)
    again = ColmapReader(folder, downscale=1).read()
    assert again.offset == (0, 0, 0)  # the world has an origin of its own
    torch.testing.assert_close(
        again.static.train.cameras.camera_to_world,
        near.static.train.cameras.camera_to_world,
        rtol=0,
        atol=1e-5,
    )


def test_photographs_are_of_a_scene_without_end(folder):
    opaque(folder)
    scene = ColmapReader(folder, downscale=1).read()
    assert not scene.space.is_linear
    assert scene.bounds.reason == "the sparse model"
    assert scene.bounds.box_source == "the common view of the static cameras"
    # Half the depth of the nearest points, which lie on this side of the middle.
    assert 1.0 < scene.bounds.near < 2.0


def test_cameras_on_one_side_make_a_forward_facing_scene(tmp_path, ring_cameras):
    ring = ring_cameras(60, width=WIDTH, height=HEIGHT, angle=0.9)[torch.arange(6)]
    (tmp_path / "images").mkdir()
    names = [f"{k}.jpg" for k in range(6)]
    for name in names:
        iio.imwrite(tmp_path / "images" / name, np.full((HEIGHT, WIDTH, 3), 99, np.uint8))
    write_sparse(tmp_path / "sparse", ring, names, POINTS)  # not sparse/0
    scene = ColmapReader(tmp_path, downscale=1).read()
    assert scene.kind == "forward" and (len(scene.static.train), len(scene.static.test)) == (5, 1)
    assert faces_forward("colmap", tmp_path, None)
    # The nearest point is at 1/0.75 of the near plane.
    model = read_model(tmp_path / "sparse")
    depths = -points_in(normalised(model)[0], model)[:, 2].numpy()
    assert depths.min() == pytest.approx(4 / 3, rel=0.1)
    with pytest.raises(DevrfError, match=r"^data\.box: the scene is forward-facing, and its space"):
        ColmapReader(tmp_path, downscale=1, box=[[-1, -1, -1], [1, 1, 1]]).read()
    around = ColmapReader(tmp_path, downscale=1, space="contracted").read()
    assert around.kind == "inward" and not faces_forward("colmap", tmp_path, "world")


def test_smaller_images_are_used_where_they_are(folder):
    averaged = ColmapReader(folder, downscale=2).read().static.train
    shutil.copytree(folder / "images", folder / "images_2")
    for path in (folder / "images_2/round").iterdir():
        whole = iio.imread(path).astype(float)
        small = whole.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 4).mean(axis=(1, 3))
        iio.imwrite(path, small.astype(np.uint8))
    reduced = ColmapReader(folder, downscale=2).read().static.train
    assert reduced.names[0].startswith("images_2/") and reduced.width == WIDTH // 2
    torch.testing.assert_close(reduced.cameras.focal, averaged.cameras.focal)
    # Of other names, as LLFF's tools write them.
    (folder / "images_2/round").rename(folder / "images_2/other")
    again = ColmapReader(folder, downscale=2).read().static.train
    assert torch.equal(again.pixels, averaged.pixels)


def test_smaller_images_that_are_not_complete_are_passed_over(folder, caplog):
    shutil.copytree(folder / "images", folder / "images_2")
    (folder / "images_2/round/img_03.png").unlink()
    with caplog.at_level(logging.INFO):
        scene = ColmapReader(folder, downscale=2).read()
    assert len(scene.static.train) + len(scene.static.test) == COUNT
    assert scene.static.train.names[0].startswith("images/") and scene.static.train.width == 40
    assert "images_2 lacks 1 of the 17 posed images: those in images/ are made" in caplog.text


def test_the_model_of_most_images_is_read_and_the_others_are_named(folder, ring_cameras, caplog):
    (folder / "sparse/0").rename(folder / "sparse/12")
    ring = ring_cameras(COUNT, width=WIDTH, height=HEIGHT, angle=0.9)
    write_sparse(folder / "sparse/0", ring[:3], NAMES[:3], POINTS)
    (folder / "sparse/1").mkdir()
    (folder / "sparse/1/cameras.txt").write_text("")
    with caplog.at_level(logging.INFO):
        scene = ColmapReader(folder, downscale=1).read()
    assert len(scene.static.train) + len(scene.static.test) == COUNT
    line = "sparse/12 is read, which poses the most images, 17; left alone: "
    lines = [record.getMessage() for record in caplog.records if line in record.getMessage()]
    assert len(lines) == 1
    assert "sparse/0 (3 images)" in lines[0] and "sparse/1 (no images.txt)" in lines[0]
    shutil.copytree(folder / "sparse/12", folder / "sparse/2")
    assert scene_model(folder)[0].folder == folder / "sparse/2"  # the first of equal ones


def test_images_without_a_pose_are_said(folder, ring_cameras, caplog):
    ColmapReader(folder, downscale=1).read()
    assert "are posed" not in caplog.text
    shutil.rmtree(folder / "sparse/0")
    ring = ring_cameras(COUNT, width=WIDTH, height=HEIGHT, angle=0.9)
    write_sparse(folder / "sparse/0", ring[:15], NAMES[:15], POINTS)
    ColmapReader(folder, downscale=1).read()
    warnings = [record for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == 1
    assert f"15 of the 17 images in {folder}/images are posed" in warnings[0].getMessage()


def test_a_camera_that_took_no_image_is_not_read(folder):
    file = folder / "sparse/0/cameras.txt"
    file.write_text(file.read_text() + "9 OPENCV_FISHEYE 80 60 88 84 42 28 0 0 0 0\n")
    assert sorted(read_model(folder / "sparse/0").cameras) == [1]


def test_full_opencv_is_read_where_nothing_divides(folder, message_of):
    rewrite(folder, "cameras", " OPENCV ", " FULL_OPENCV ")
    rewrite(folder, "cameras", "\n", " 0.05 0 0 0\n")
    (lens,) = {known.distortion for known in read_model(folder / "sparse/0").intrinsics}
    assert lens == Distortion((-0.3, 0.1, 0.05, 0.0), (0.006, -0.008))
    rewrite(folder, "cameras", " 0.05 0 0 0\n", " 0.05 0 0.01 0\n")
    assert "camera model FULL_OPENCV is not supported" in message_of(folder)


@pytest.fixture
def moving(folder) -> Path:
    """Three fixed cameras of three frames stand where 00, 02 and 04 were taken."""
    for view in range(3):
        name = f"img_{2 * view:02d}"
        (folder / f"images/round/{name}.png").rename(folder / f"images/round/view{view + 1}.png")
        rewrite(folder, "images", name, f"view{view + 1}")
        images = folder / f"dynamic_3views/view{view + 1}/images"
        images.mkdir(parents=True)
        for t in range(3):
            shade = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
            shade[..., 0] = 10 * view + t
            iio.imwrite(images / f"{t}.png", shade)
    return folder


def test_fixed_views_are_posed_by_an_image_of_each(moving, message_of):
    scene = ColmapReader(moving, downscale=1).read()
    train, test = scene.dynamic.train, scene.dynamic.test
    assert train.pixels[:, 0, 0, 0].tolist() == [0, 10, 1, 11, 2, 12]
    assert train.times.tolist() == [0, 0, 0.5, 0.5, 1, 1] and train.view.tolist() == [0, 1] * 3
    assert test.pixels[:, 0, 0, 0].tolist() == [20, 21, 22]
    at_rest = dict(zip(scene.static.train.names, scene.static.train.cameras.positions, strict=True))
    torch.testing.assert_close(at_rest["images/round/view2.png"], train.cameras.positions[1])
    # What stands where the held-out camera does is not learned from.
    assert "images/round/view3.png" in scene.static.test.names
    (moving / "dynamic_3views").rename(moving / "dynamic_4views")
    shutil.copytree(moving / "dynamic_4views/view1", moving / "dynamic_4views/view4")
    assert "sparse/0: poses no image view4.png, nor one in a folder view4" in message_of(moving)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda root: shutil.rmtree(root / "sparse"), "balls: no COLMAP model"),
        (
            lambda root: (root / "sparse/0/points3D.txt").write_text(""),
            "sparse/0: its images show 0 sparse points, expected 50 or more",
        ),
        (
            lambda root: rewrite(root, "cameras", " OPENCV ", " OPENCV_FISHEYE "),
            "sparse/0: camera model OPENCV_FISHEYE is not supported, only SIMPLE_PINHOLE",
        ),
        (
            lambda root: (root / "sparse/0/points3D.txt").rename(root / "sparse/0/points3D.ply"),
            "sparse/0/points3D.txt: no such file; a COLMAP model is cameras, images, points3D",
        ),
        (
            lambda root: rewrite(root, "images", "round/img_", "my photo_"),
            "sparse/0: poses 'my' twice; text models cut names at spaces",
        ),
    ],
)
def test_what_is_wrong_is_one_line(folder, message_of, change, said):
    change(folder)
    assert said in message_of(folder)


def rewrite(root: Path, part: str, old: str, new: str) -> None:
    file = root / f"sparse/0/{part}.txt"
    file.write_text(file.read_text().replace(old, new))


HALF = 0.5**0.5


def test_the_name_of_an_image_is_utf8(folder, message_of):
    file = folder / "sparse/0/images.txt"
    file.write_bytes(file.read_bytes().replace(b"img_10", b"caf\xe9"))
    said = r"the name of its image round/caf\xe9.png is not UTF-8 text; rename it"
    assert said in message_of(folder)


@pytest.mark.parametrize("number", [2**31, 2**62])
@pytest.mark.parametrize(
    ("part", "place", "form"),
    [
        *[(part, 0, "<Q") for part in ("frames", "images", "points3D")],
        ("frames", 72, "<I"),  # images of the first one
        ("images", 8 + 64 + len(NAMES[0]) + 1, "<Q"),  # what the first one shows
        ("points3D", 51, "<Q"),  # the images that show the first one
    ],
)
def test_counts_that_a_binary_model_cannot_hold_are_refused_before_they_are_believed(
    folder, message_of, part, place, form, number
):
    model = folder / "sparse/0"
    importlib.import_module("pycolmap").Reconstruction(model).write_binary(model)
    assert len(ColmapReader(folder, downscale=1).read().static.train) == 14
    data = bytearray((model / f"{part}.bin").read_bytes())
    struct.pack_into(form, data, place, min(number, 2 ** (8 * struct.calcsize(form)) - 1))
    (model / f"{part}.bin").write_bytes(data)
    said = f"{model}: not a readable COLMAP model ({part}.bin counts more than "
    assert message_of(folder).startswith(said)


def test_zeros_behind_a_binary_model_take_no_memory(folder):
    model = folder / "sparse/0"
    importlib.import_module("pycolmap").Reconstruction(model).write_binary(model)
    for part in ("images", "points3D"):
        os.truncate(model / f"{part}.bin", 2**34)  # of zeros, which take no room on the disk
    before = own_memory()
    assert len(ColmapReader(folder, downscale=1).read().static.train) == 14
    assert own_memory() - before < 300e6


def test_a_text_model_without_end_is_refused(folder, message_of):
    (folder / "sparse/0/points3D.txt").unlink()
    for part in ("points3D", "frames"):
        with (folder / f"sparse/0/{part}.txt").open("wb") as file:
            file.truncate(2**34)  # of zeros: to COLMAP one line
        said = f"{part}.txt is larger than 256 MiB: convert the model to binary"
        assert said in message_of(folder)
        (folder / f"sparse/0/{part}.txt").write_text("")
    (folder / "sparse/0/frames.txt").unlink()
    os.mkfifo(folder / "sparse/0/frames.txt")
    assert "(frames.txt is no file)" in message_of(folder)


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_cameras_poses_and_depths_by_hand(tmp_path, suffix):
    """Camera 7 at (1, 2, 3), turned by 90 degrees about its viewing axis z; two points."""
    (tmp_path / "cameras.txt").write_text("7 OPENCV 64 48 50 51 32 24 0.1 0.01 0.001 0.002\n")
    (tmp_path / "images.txt").write_text(
        f"1 1 0 0 0 0 0 0 7 b.png\n5 6 11 1 1 -1\n"
        f"2 {HALF} 0 0 {HALF} 2 -1 -3 7 a.png\n5 6 4 7 8 11\n"
    )
    (tmp_path / "points3D.txt").write_text("11 1 2 8 9 9 9 0.5 1 0 2 1\n4 0 0 5 9 9 9 0.5 2 0\n")
    if suffix == ".bin":
        library = importlib.import_module("pycolmap")
        library.Reconstruction(tmp_path).write_binary(tmp_path)
        for path in tmp_path.glob("*.txt"):
            path.unlink()
    model = read_model(tmp_path)
    assert [image.name for image in model.images] == ["a.png", "b.png"]
    keys = {"fl_x": 50, "fl_y": 51, "cx": 32, "cy": 24, "w": 64, "h": 48}
    assert model.cameras[7] == keys | {"k1": 0.1, "k2": 0.01, "p1": 0.001, "p2": 0.002}
    turned, straight = model.poses
    # World to camera (x, y, z) → (−y, x, z) + t, so the camera is at (1, 2, 3); its y is flipped.
    assert torch.allclose(turned[:, 3], torch.tensor([1.0, 2.0, 3.0]).double())
    expected = torch.tensor([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]]).double()
    assert torch.allclose(turned[:, :3], expected, atol=1e-12)
    assert torch.allclose(straight[:, :3], torch.diag(torch.tensor([1.0, -1, -1])).double())
    assert model.depths(0).tolist() == pytest.approx([5 - 3, 8 - 3])
    assert model.depths(1).tolist() == [8.0]
