"""Images of several sizes in one set: where they are, what is beside them, what is refused."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.scenes.bounds import seen_radius
from devrf.scenes.export import export
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.colmap import ColmapReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.lens import Lens
from devrf.scenes.optical_flow import estimate_flow
from devrf.scenes.reduced import reduced
from devrf.scenes.scene import Scene, Views
from devrf.scenes.silhouettes import motion_box, visual_hull
from devrf.scenes.sparse_model import normalised, read_model
from devrf.scenes.validation import same_shape
from layouts import points_in, write_sparse

COUNT = 9
# Landscape and portrait in turn, by one phone; principal points off the middle.
LENSES = (Lens((88.0, 84.0), (50.0, 34.0)), Lens((84.0, 88.0), (38.0, 50.0)))
SIZES = ((96, 72), (72, 96))


def keys(lens: Lens, size: tuple[int, int]) -> dict[str, float]:
    (fx, fy), (cx, cy) = lens.focal, lens.center
    return {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": size[0], "h": size[1]}


@pytest.fixture
def photos(tmp_path, ring_cameras, picture) -> tuple[Path, Cameras]:
    """Pictures of the balls, ``images/0.png`` and so on, and the cameras' poses."""
    cameras = ring_cameras(COUNT, width=96, height=72, angle=0.9)
    (tmp_path / "scene/images").mkdir(parents=True)
    for k, pose in enumerate(cameras.camera_to_world):
        image = picture(pose, LENSES[k % 2], SIZES[k % 2][0], SIZES[k % 2][1])
        iio.imwrite(tmp_path / f"scene/images/{k}.png", image)
    return tmp_path / "scene", cameras


@pytest.fixture
def listed(photos) -> Path:
    """The pictures in nerfstudio's layout."""
    root, cameras = photos
    frames = [
        {
            "file_path": f"images/{k}.png",
            "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]],
            **keys(LENSES[k % 2], SIZES[k % 2]),
        }
        for k, pose in enumerate(cameras.camera_to_world)
    ]
    (root / "transforms.json").write_text(json.dumps({"frames": frames}))
    return root


def edit(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads((root / "transforms.json").read_text())
    change(content)
    (root / "transforms.json").write_text(json.dumps(content))


def is_beside(views: Views) -> torch.Tensor:
    """(N, H, W) what belongs to no image, by the images' names."""
    mask = torch.ones(views.pixels.shape[:3], dtype=torch.bool)
    for k, name in enumerate(views.names):
        width, height = SIZES[int(Path(name).stem) % 2]
        mask[k, :height, :width] = False
    return mask


@pytest.mark.parametrize("downscale", [1, 2])
def test_each_image_is_read_with_its_own_camera(listed, balls_are_where_they_project, downscale):
    scene = NerfstudioReader(listed, downscale=downscale).read()
    for views in (scene.static.train, scene.static.test):
        balls_are_where_they_project(views)
        for k, name in enumerate(views.names):
            size = SIZES[int(Path(name).stem) % 2]
            assert views.cameras.size_of(k) == (size[0] // downscale, size[1] // downscale)
            alone = views.single(k)
            assert alone.pixels.shape[1:3] == (size[1] // downscale, size[0] // downscale)
            assert alone.cameras.center[0].tolist() == views.cameras.center[k].tolist()
            assert alone.valid_mask is None and alone.names == (name,)
    if downscale == 1:
        train = scene.static.train
        assert (train.width, train.height) == (96, 96)
        beside = is_beside(train)
        assert torch.equal(train.valid_mask, ~beside)
        # Nothing is cut out there.
        assert set(map(tuple, train.pixels[beside].tolist())) == {(0, 0, 0, 255)}
        file = iio.imread(listed / train.names[0])
        assert np.array_equal(train.single(0).pixels[0].numpy(), file)


def test_a_sparse_model_with_two_cameras(photos, balls_are_where_they_project):
    root, cameras = photos
    balls = torch.tensor([[1.2, 0.1, 0.45], [-0.6, 1.0, 0.0], [0.1, -1.1, -0.45]])
    points = torch.cat([balls, torch.rand(20, 3, generator=torch.Generator().manual_seed(0))])
    model = root / "sparse/0"
    write_sparse(model, cameras, [f"{k}.png" for k in range(COUNT)], points)
    rows = (model / "images.txt").read_text().splitlines()
    for k in range(0, len(rows), 2):
        number, name = rows[k].split()[0], rows[k].split()[-1]
        second = int(name[0]) % 2
        rows[k] = " ".join([number, *rows[k].split()[1:8], str(second + 1), name])
    (model / "images.txt").write_text("\n".join(rows) + "\n")
    lines = (
        f"{k + 1} PINHOLE {w} {h} {' '.join(map(str, (*lens.focal, *lens.center)))}\n"
        for k, (lens, (w, h)) in enumerate(zip(LENSES, SIZES, strict=True))
    )
    (model / "cameras.txt").write_text("".join(lines))
    scene = ColmapReader(root, downscale=1).read()
    sparse = read_model(model)
    centers = points_in(normalised(sparse)[0], sparse)[:3].float()
    for views in (scene.static.train, scene.static.test):
        balls_are_where_they_project(views, centers)
        assert {views.cameras.size_of(k) for k in range(len(views))} <= set(SIZES)
    assert scene.static.train.valid_mask is not None


def test_sizes_that_differ_by_a_pixel_are_sizes_too(listed):
    image = iio.imread(listed / "images/2.png")
    iio.imwrite(listed / "images/2.png", image[:71, :95])
    edit(listed, lambda c: c["frames"][2].update(w=95, h=71))
    train = NerfstudioReader(listed, downscale=1).read().static.train
    position = train.names.index("images/2.png")
    assert train.cameras.size_of(position) == (95, 71)
    assert not bool(train.valid_mask[position, 71].any() | train.valid_mask[position, :, 95].any())


def test_each_mask_is_that_of_its_own_image(listed, caplog):
    for k, (width, height) in enumerate(SIZES):
        mask = np.full((height, width), 255, dtype=np.uint8)
        mask[: height // 2] = 0
        iio.imwrite(listed / f"mask{k}.png", mask)
    edit(
        listed,
        lambda c: [f.update(mask_path=f"mask{k % 2}.png") for k, f in enumerate(c["frames"])],
    )
    with caplog.at_level(logging.INFO):
        train = NerfstudioReader(listed, downscale=1).read().static.train
    assert "leave out 50.0 % of the pixels" in caplog.text
    for k, name in enumerate(train.names):
        width, height = SIZES[int(Path(name).stem) % 2]
        assert int(train.valid_mask[k].sum()) == width * height // 2
        own = train.valid_mask_of(k)
        assert own is not None and own.shape == (height, width) and bool(own[height // 2 :].all())
    # As alpha masks they leave out nothing beside the images.
    cut = NerfstudioReader(listed, downscale=1, masks="alpha").read().static.train
    assert bool((cut.pixels[is_beside(cut)][:, 3] == 255).all())


def test_a_set_of_one_size_has_no_mask(listed):
    edit(listed, lambda c: c.update(frames=c["frames"][::2]))
    train = NerfstudioReader(listed, downscale=1).read().static.train
    assert train.valid_mask is None and train.cameras.sizes is None
    assert (train.width, train.height) == SIZES[0]


def test_opaque_images_of_two_sizes_have_no_alpha_mask(listed):
    for path in (listed / "images").iterdir():
        iio.imwrite(path, np.full_like(iio.imread(path), 255))
    scene = NerfstudioReader(listed, downscale=1).read()
    assert not scene.static.train.cut_out
    assert scene.bounds.reason.startswith("the images have no alpha masks")


def test_a_camera_without_a_size_is_that_of_one_size(listed, refusal):
    def shared(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            for key in keys(LENSES[0], SIZES[0]):
                del frame[key]
        content.update(fl_x=88, fl_y=84, cx=50, cy=34)

    edit(listed, shared)
    message = refusal(NerfstudioReader, listed, downscale=1)
    assert "72x96 px, but" in message and "has 96x72 px" in message and "fl_x, cx, cy" in message
    # An angle alone fits the same image at another scale, but no other shape.
    edit(listed, lambda c: [c.pop(key) for key in ("fl_x", "fl_y", "cx", "cy")])
    edit(listed, lambda c: c.update(camera_angle_x=0.9))
    assert "their camera names no size" in refusal(NerfstudioReader, listed, downscale=1)
    edit(listed, lambda c: c.update(frames=c["frames"][::2]))
    image = iio.imread(listed / "images/2.png")
    iio.imwrite(listed / "images/2.png", cv2.resize(image, (48, 36)))
    train = NerfstudioReader(listed, downscale=1).read().static.train
    small = train.names.index("images/2.png")
    focal = train.cameras.focal[:, 0]
    assert float(focal[small]) == pytest.approx(float(focal[small - 1]) / 2)


@pytest.mark.parametrize(
    ("image", "camera", "same"),
    [
        *(((1023 // k, 769 // k), (1023, 769), True) for k in (1, 2, 4, 8)),
        *(((round(1023 / k), round(769 / k)), (1023, 769), True) for k in (2, 4, 8)),
        ((4096, 3072), (1024, 768), True),
        ((93, 72), (96, 72), False),  # cropped by 3 %
        ((1000, 768), (1024, 768), False),  # by 2 %
        ((96, 72), (1024, 800), False),
        ((72, 96), (96, 72), False),
        ((100, 98), (98, 100), False),  # turned
    ],
)
def test_sides_are_rounded_by_one_pixel(image, camera, same):
    assert same_shape(image, camera) == same_shape(camera, image) == same


def test_a_cropped_image_does_not_fit_its_camera(listed, refusal):
    iio.imwrite(listed / "images/2.png", iio.imread(listed / "images/2.png")[:69])
    message = refusal(NerfstudioReader, listed, downscale=1)
    assert "images/2.png: 96x69 px, but its camera is one for 96x72 px" in message


@pytest.mark.parametrize("smaller", ["cpu", "up_to_2"])
def test_the_longest_image_says_by_what_all_are_made_smaller(listed, smaller):
    for k in range(1, COUNT, 2):
        path = listed / f"images/{k}.png"
        iio.imwrite(path, cv2.resize(iio.imread(path), (720, 960)))
    reader = NerfstudioReader(listed, downscale=smaller)
    train = reader.read().static.train
    assert reader.factor == 2 and (train.width, train.height) == (360, 480)


def in_a_larger_raster(views: Views) -> Views:
    """The same images with 8 rows and 8 columns beside them."""
    beside = torch.nn.functional.pad
    mask = views.valid_mask
    mask = torch.ones(views.pixels.shape[:3], dtype=torch.bool) if mask is None else mask
    pixels = beside(views.pixels, (0, 0, 0, 8, 0, 8))
    pixels[~beside(mask, (0, 8, 0, 8))] = torch.tensor([0, 0, 0, 255], dtype=torch.uint8)
    cameras = Cameras(
        views.cameras.camera_to_world,
        views.cameras.focal,
        views.cameras.center,
        views.width + 8,
        views.height + 8,
        views.cameras.extents.long(),
    )
    return Views(
        pixels, cameras, views.times, views.view, views.names, valid_mask=beside(mask, (0, 8, 0, 8))
    )


def test_hulls_and_boxes_end_where_images_do(ball_views, cube):
    places = torch.tensor([[-0.4, 0.0, 0.0], [0.6, 0.1, 0.2]])
    views = ball_views(places, 0.35)
    larger = in_a_larger_raster(views)
    assert motion_box(larger, cube) == motion_box(views, cube)
    still, still_larger = (v[torch.arange(4)] for v in (views, larger))
    box = Box((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0))
    for whole in (False, True):
        hull = visual_hull(still, box, (24, 24, 24), whole_in_view=whole)
        again = visual_hull(still_larger, box, (24, 24, 24), whole_in_view=whole)
        assert torch.equal(hull, again)
    middle = torch.zeros(3)
    assert seen_radius(larger.cameras, middle) == seen_radius(views.cameras, middle)


def test_flow_is_estimated_within_images(tiny_scene):
    views = tiny_scene.dynamic.train
    alone = estimate_flow(views, "dis")
    flow = estimate_flow(in_a_larger_raster(views), "dis")
    assert torch.equal(flow.vectors[:, :18, :24], alone.vectors)
    assert torch.equal(flow.valid[:, :18, :24], alone.valid)
    assert not bool(flow.valid[:, 18:].any() | flow.valid[:, :, 24:].any())


def same_views(ours: Views, read: Views) -> None:
    assert torch.equal(ours.pixels, read.pixels) and torch.equal(ours.valid_mask, read.valid_mask)
    assert torch.equal(ours.cameras.sizes, read.cameras.sizes)
    for name in ("camera_to_world", "focal", "center"):
        torch.testing.assert_close(getattr(read.cameras, name), getattr(ours.cameras, name))


def test_what_is_exported_reads_back_the_same(two_sizes: Scene, tmp_path: Path):
    export(two_sizes, tmp_path / "scene")
    again = BlenderReader(tmp_path / "scene").read()
    same_views(two_sizes.static.train, again.static.train)
    same_views(two_sizes.dynamic.train, again.dynamic.train)
    same_views(two_sizes.dynamic.test, again.dynamic.test)
    ours, flow = two_sizes.dynamic.train.flow, again.dynamic.train.flow
    assert torch.equal(flow.valid, ours.valid)
    assert torch.equal(flow.vectors[flow.valid], ours.vectors[ours.valid])


def test_smaller_images_have_nothing_of_what_is_beside_larger_ones(two_sizes: Scene):
    small = reduced(two_sizes, 16).static.train
    assert (small.width, small.height) == (16, 12)
    # Of 18 of 24 columns 12 of 16 are left, and of 16 of 18 rows 10 whole ones of 12.
    assert small.cameras.sizes[:2].tolist() == [[12, 12], [16, 10]]
    assert [int(mask.sum()) for mask in small.valid_mask[:2]] == [144, 160]
