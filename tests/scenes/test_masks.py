"""Masks of nerfstudio's frames: pixels that do not count, or mattes."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from devrf.artifacts.image_advice import image_advice
from devrf.artifacts.inspection import inspect_scene
from devrf.artifacts.inspection_picture import counted_pixels
from devrf.data.flow_source import with_flow
from devrf.data.nerfstudio import NerfstudioDataModule
from devrf.data.pool import all_pixels
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.distortion import Distortion
from devrf.scenes.lens import Lens
from devrf.scenes.nerfstudio import NerfstudioReader
from devrf.scenes.visual_hull import visual_hull

WIDTH, HEIGHT = 80, 60
LENS = Lens((88.0, 84.0), (42.0, 28.0), Distortion((-0.3, 0.1, 0.01, 0.0), (0.006, -0.008)))
SHARED = {
    "fl_x": 88.0,
    "fl_y": 84.0,
    "cx": 42.0,
    "cy": 28.0,
    "w": WIDTH,
    "h": HEIGHT,
    "k1": -0.3,
    "k2": 0.1,
    "k3": 0.01,
    "p1": 0.006,
    "p2": -0.008,
}


@pytest.fixture
def root(tmp_path: Path, ring_cameras: Callable[..., Any], picture: Callable[..., Any]) -> Path:
    """Nine RGB images of balls by a moving camera, and masks that are white on the balls."""
    folder = tmp_path / "scene"
    (folder / "masks").mkdir(parents=True)
    frames = []
    ring = ring_cameras(9, width=WIDTH, height=HEIGHT, angle=0.9)
    for k, pose in enumerate(ring.camera_to_world):
        pixels = picture(pose, LENS, WIDTH, HEIGHT)
        Image.fromarray(pixels[..., :3]).save(folder / f"{k}.png")
        Image.fromarray(pixels).save(folder / f"cut_{k}.png")
        Image.fromarray(pixels[..., 3]).save(folder / f"masks/{k}.png")
        matrix = torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]])]).tolist()
        frames.append(
            {
                "file_path": f"{k}.png",
                "mask_path": f"masks/{k}.png",
                "transform_matrix": matrix,
                "time": k / 8,
            }
        )
    (folder / "transforms.json").write_text(json.dumps({**SHARED, "frames": frames}))
    return folder


def edit(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads((root / "transforms.json").read_text())
    change(content)
    (root / "transforms.json").write_text(json.dumps(content))


def paint(root: Path, k: int, values: np.ndarray, **options: Any) -> None:
    """Another mask for image ``k``."""
    Image.fromarray(values).save(root / f"masks/{k}.png", **options)


def half(value: int = 255) -> np.ndarray:
    """A mask that is white on the left."""
    values = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    values[:, : WIDTH // 2] = value
    return values


def plain(root: Path, masks: list[np.ndarray] | None = None) -> None:
    """No distortion, and masks of one's own for all images."""
    edit(root, lambda c: [c.pop(key) for key in ("k1", "k2", "k3", "p1", "p2")])
    for k in range(9):
        paint(root, k, half() if masks is None else masks[k])


@pytest.mark.parametrize("downscale", [1, 2, 3])
def test_mattes_are_those_of_images_that_were_cut_out(root: Path, downscale: int) -> None:
    ours = NerfstudioReader(root, downscale=downscale, masks="matte").read().dynamic.train
    edit(root, lambda c: [f.update(file_path=f"cut_{f['file_path']}") for f in c["frames"]])
    theirs = NerfstudioReader(root, downscale=downscale, masks="none").read().dynamic.train
    assert ours.valid_mask is None and torch.equal(ours.pixels, theirs.pixels)


@pytest.mark.parametrize("downscale", [1, 2])
def test_a_pixel_counts_if_all_that_it_is_made_of_does(root: Path, downscale: int) -> None:
    for k in range(9):
        with Image.open(root / f"masks/{k}.png") as mask:
            sharp = np.where(np.asarray(mask) > 127, 255, 0).astype(np.uint8)
        paint(root, k, sharp)
    valid_mask = NerfstudioReader(root, downscale=downscale).read().dynamic.train.valid_mask
    # Downscaling and undistortion blur the matte as they blur the picture.
    mattes = NerfstudioReader(root, downscale=downscale, masks="matte").read().dynamic.train
    assert valid_mask is not None and torch.equal(valid_mask, mattes.pixels[..., 3] == 255)
    assert 0 < int(valid_mask.sum()) < valid_mask.numel()


def test_they_can_be_left_alone(root: Path) -> None:
    edit(root, lambda c: c["frames"][0].update(mask_path="nowhere.png"))
    train = NerfstudioReader(root, masks="none").read().dynamic.train
    assert train.valid_mask is None and not train.has_alpha


def test_only_some_images_have_one(root: Path) -> None:
    plain(root)
    edit(root, lambda c: [f.pop("mask_path") for f in c["frames"][2:]])
    train = NerfstudioReader(root).read().dynamic.train
    valid_mask = train.valid_mask
    assert valid_mask is not None and torch.equal(
        valid_mask[0, 0], torch.arange(WIDTH) < WIDTH // 2
    )
    assert bool(valid_mask[2:].all())
    with pytest.raises(DevrfError, match="2.png: has no mask_path although others have"):
        NerfstudioReader(root, masks="matte").read()


@pytest.mark.parametrize("kind", ["L", "labels", "1", "P", "RGB", "RGBA", "LA", "dull"])
def test_whatever_is_grey_will_do(root: Path, kind: str) -> None:
    plain(root)
    for k in range(9):
        image = Image.fromarray(half({"labels": 1, "dull": 200}.get(kind, 255)))
        image = image if kind in ("labels", "dull") else image.convert(kind)
        image.save(root / f"masks/{k}.png")
    valid_mask = NerfstudioReader(root).read().dynamic.train.valid_mask
    assert valid_mask is not None
    assert bool(valid_mask[:, :, : WIDTH // 2].all()) and not bool(
        valid_mask[:, :, WIDTH // 2 :].any()
    )


def test_a_mask_may_be_of_the_size_of_the_camera(root: Path) -> None:
    plain(root)
    for k in range(9):
        with Image.open(root / f"{k}.png") as image:
            image.resize((WIDTH // 2, HEIGHT // 2)).save(root / f"{k}.png")
    for masks in ("ignore", "matte"):
        train = NerfstudioReader(root, masks=masks).read().dynamic.train  # type: ignore[arg-type]
        kept = train.pixels[..., 3] == 255 if train.valid_mask is None else train.valid_mask
        assert torch.equal(kept[0, 0], torch.arange(WIDTH // 2) < WIDTH // 4)


def write_deep(root: Path) -> None:
    Image.fromarray(half().astype(np.uint16) * 257).save(root / "masks/1.png")


@pytest.mark.parametrize("masks", ["ignore", "matte"])
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda r: edit(r, lambda c: c["frames"][1].update(mask_path="masks/x.png")),
            "masks/x.png: no such mask; correct mask_path, or set data.masks=none",
        ),
        (
            lambda r: edit(r, lambda c: c["frames"][1].update(mask_path=3)),
            "frames[1].mask_path: should be a valid string, not 3",
        ),
        (lambda r: edit(r, lambda c: c["frames"][1].update(mask_path="../../m.png")), "m.png"),
        (lambda r: edit(r, lambda c: c["frames"][1].update(mask_path="masks")), "no such mask"),
        (lambda r: paint(r, 1, half()[:, :40]), "masks/1.png: 40x60 px, but its image"),
        (
            lambda r: paint(r, 1, np.stack([half(), half(), 255 - half()], axis=2)),
            "masks/1.png: a mask with colours or an alpha channel",
        ),
        (lambda r: paint(r, 1, np.stack([half(), half()], axis=2)), "an alpha channel"),
        (write_deep, "masks/1.png: expected 8 bits a channel"),
        (lambda r: (r / "masks/1.png").write_text("nothing"), "masks/1.png: not a readable image"),
    ],
)
def test_wrong_masks(root: Path, masks: str, spoil: Callable[[Path], object], said: str) -> None:
    spoil(root)
    with pytest.raises(DevrfError) as caught:
        NerfstudioReader(root, masks=masks).read()  # type: ignore[arg-type]
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_mask_that_leaves_nothing(root: Path) -> None:
    paint(root, 4, 0 * half())
    with pytest.raises(DevrfError, match=r"masks/4.png: leaves nothing of .*4.png to learn from"):
        NerfstudioReader(root).read()
    # Nothing may be there to be cut out.
    assert not bool(
        NerfstudioReader(root, masks="matte").read().dynamic.train.pixels[4, ..., 3].any()
    )


def test_an_option_that_is_none(root: Path) -> None:
    with pytest.raises(DevrfError, match="data.masks: should be 'ignore', 'matte' or 'none'"):
        NerfstudioReader(root, masks="yes").read()  # type: ignore[arg-type]


def test_only_pixels_that_count_are_drawn(root: Path) -> None:
    plain(root)
    train = NerfstudioDataModule(root, flow="none").scene.dynamic.train
    assert train.valid_mask is not None
    pool = all_pixels(train, torch.tensor([2, 0]))
    assert len(pool) == 2 * WIDTH * HEIGHT // 2
    assert sorted(set(pool.image.tolist())) == [0, 2]
    assert int((pool.flat % WIDTH).max()) == WIDTH // 2 - 1
    assert pool.image.dtype == pool.flat.dtype == torch.int32


def test_masks_go_with_their_images(root: Path) -> None:
    masks = [half() if k % 2 else 255 - half() for k in range(9)]
    plain(root, masks)
    train = NerfstudioReader(root).read().dynamic.train
    assert train.valid_mask is not None
    one = train[torch.tensor([3])].to("cpu").valid_mask
    assert one is not None and torch.equal(one[0], train.valid_mask[3])


def test_flow_is_valid_at_pixels_that_count(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain(root)
    scene = NerfstudioReader(root).read()
    everywhere = lambda now, before: torch.zeros(HEIGHT, WIDTH, 2)  # noqa: E731
    monkeypatch.setattr("devrf.scenes.optical_flow.estimator", lambda method: everywhere)
    flow = with_flow(scene, "dis", None).dynamic.train.flow
    valid_mask = scene.dynamic.train.valid_mask
    assert flow is not None and valid_mask is not None
    assert bool(flow.valid[1].any()) and not bool((flow.valid & ~valid_mask).any())


def test_inspecting_says_how_much_they_cover(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    plain(root, [255 - half() if k == 3 else half() for k in range(9)])
    with caplog.at_level(logging.INFO):
        scene = NerfstudioReader(root).read()
    assert "masks of 8 images leave out 50.0 % of the pixels of all" in caplog.text
    facts = inspect_scene(scene).sets[0]
    assert facts.mattes is None and facts.left_out == pytest.approx(0.5)
    assert not [advice for advice in image_advice(scene) if "masks" in advice.what]
    abbreviated = counted_pixels(scene.dynamic.train, 0)
    assert abbreviated.shape[2] == 4 and abbreviated[0, :, 3].tolist() == [255] * 40 + [0] * 40
    matte = inspect_scene(NerfstudioReader(root, masks="matte").read()).sets[0]
    assert matte.mattes == pytest.approx(0.5) and matte.left_out is None


def test_masks_that_cut_out_the_subject_are_told_from_others(root: Path) -> None:
    found = [a for a in image_advice(NerfstudioReader(root).read()) if "masks" in a.what]
    assert len(found) == 1 and "set data.masks=matte" in found[0].remedy
    assert found[0].where.startswith("static training set, ")


def test_where_pixels_do_not_count_nothing_is_carved_away(root: Path) -> None:
    views = NerfstudioReader(root, masks="matte").read().static.train
    box = Box.of((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    whole = visual_hull(views, box, (12, 12, 12))
    nothing = replace(views, valid_mask=torch.zeros(views.pixels.shape[:3], dtype=torch.bool))
    assert 0 < int(whole.sum()) < whole.numel()
    assert bool(visual_hull(nothing, box, (12, 12, 12)).all())
