"""Masks of nerfstudio's frames: pixels that are ignored, or background."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from devrf.apps.inspection.advice import advice_on
from devrf.errors import DevrfError
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.images import read_header
from devrf.scenes.masks import _grey

WIDTH, HEIGHT = 80, 60


@pytest.fixture
def root(tmp_path, balls) -> Path:
    """Nine RGB images of balls by a moving camera, and masks that are white on the balls."""
    folder = tmp_path / "scene"
    content = balls.write(folder, [k / 8 for k in range(9)])
    (folder / "masks").mkdir()
    for k, frame in enumerate(content["frames"]):
        with Image.open(folder / frame["file_path"]) as image:
            image.save(folder / f"cut_{k}.png")
            image.getchannel("A").save(folder / f"masks/{k}.png")
            image.convert("RGB").save(folder / f"{k}.png")
        frame |= {"file_path": f"{k}.png", "mask_path": f"masks/{k}.png"}
    edit(folder, lambda listed: listed.update(content))
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


def plain(root: Path) -> None:
    """No distortion, and masks of one half for all images."""
    edit(root, lambda c: [c.pop(key) for key in ("k1", "k2", "k3", "p1", "p2")])
    for k in range(9):
        paint(root, k, half())


@pytest.mark.parametrize("downscale", [1, 3])
def test_alpha_masks_are_those_of_images_that_were_cut_out(root, downscale):
    ours = NerfstudioReader(root, downscale=downscale, masks="alpha").read().dynamic.train
    edit(root, lambda c: [f.update(file_path=f"cut_{f['file_path']}") for f in c["frames"]])
    theirs = NerfstudioReader(root, downscale=downscale, masks="none").read().dynamic.train
    assert ours.valid_mask is None and torch.equal(ours.pixels, theirs.pixels)


def test_a_pixel_is_valid_if_all_that_it_is_made_of_is(root):
    for k in range(9):
        with Image.open(root / f"masks/{k}.png") as mask:
            sharp = np.where(np.asarray(mask) > 127, 255, 0).astype(np.uint8)
        paint(root, k, sharp)
    valid_mask = NerfstudioReader(root, downscale=2).read().dynamic.train.valid_mask
    # Downscaling and undistortion blur the matte as they blur the picture.
    cut_out = NerfstudioReader(root, downscale=2, masks="alpha").read().dynamic.train
    assert valid_mask is not None and torch.equal(valid_mask, cut_out.pixels[..., 3] == 255)
    assert 0 < int(valid_mask.sum()) < valid_mask.numel()


def test_only_some_images_have_one(root):
    plain(root)
    edit(root, lambda c: [f.pop("mask_path") for f in c["frames"][2:]])
    train = NerfstudioReader(root).read().dynamic.train
    valid_mask = train.valid_mask
    assert valid_mask is not None and torch.equal(
        valid_mask[0, 0], torch.arange(WIDTH) < WIDTH // 2
    )
    assert bool(valid_mask[2:].all())
    with pytest.raises(DevrfError, match="2.png: has no mask_path although others have"):
        NerfstudioReader(root, masks="alpha").read()


FILES = {
    "labels": lambda: Image.fromarray(half(1)),
    "bits": lambda: Image.fromarray(half()).convert("1"),
    "RGB": lambda: Image.fromarray(half()).convert("RGB"),
    "alpha of black": lambda: Image.fromarray(np.dstack([0 * half()] * 3 + [half()])),
    "alpha of white": lambda: Image.fromarray(np.dstack([half()] * 4)),
}


@pytest.mark.parametrize("kind", FILES)
def test_grey_files_and_alpha_channels_are_masks(root, kind):
    plain(root)
    for k in range(9):
        FILES[kind]().save(root / f"masks/{k}.png")
    valid = NerfstudioReader(root).read().dynamic.train.valid_mask
    assert valid is not None
    assert bool(valid[:, :, : WIDTH // 2].all()) and not bool(valid[:, :, WIDTH // 2 :].any())


def test_noise_in_a_black_mask_is_no_label(root):
    plain(root)
    # What a network gives for an image without the subject.
    paint(root, 2, half(1))
    train = NerfstudioReader(root, masks="alpha").read().dynamic.train
    assert train.pixels[..., 3].amax(dim=(1, 2)).sort().values.tolist() == [1, *[255] * 7]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda r: edit(r, lambda c: c["frames"][1].update(mask_path="masks/x.png")),
            "masks/x.png: no such mask",
        ),
        (lambda r: paint(r, 1, half()[:, :40]), "masks/1.png: 40x60 px, but its image"),
        (
            lambda r: paint(r, 1, np.stack([half(), half(), 255 - half()], axis=2)),
            "masks/1.png: a mask with colours",
        ),
        (
            lambda r: paint(r, 1, np.stack([half(), half().T.reshape(HEIGHT, WIDTH)], axis=2)),
            "masks/1.png: a mask whose colours and alpha channel differ",
        ),
        (
            lambda r: [paint(r, k, half(2) // (1 + k % 2)) for k in range(9)],
            "masks: masks of labels 0, 1, 2, expected black and white",
        ),
        (
            lambda r: [paint(r, k, half(38)) for k in range(9)],
            "masks: masks of labels 0, 38, expected black and white",
        ),
        (lambda r: paint(r, 4, 0 * half()), "masks/4.png: leaves nothing"),
    ],
)
def test_wrong_masks(root, spoil, said):
    spoil(root)
    with pytest.raises(DevrfError) as caught:
        NerfstudioReader(root).read()
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_masks_that_cut_out_the_subject_are_told_from_others(root):
    found = [a for a in advice_on(NerfstudioReader(root).read()) if "masks" in a.problem]
    assert len(found) == 1 and "set data.masks=alpha" in found[0].remedy
    assert found[0].where.startswith("static training set, ")


@pytest.mark.parametrize("columns", [16, 4000])  # read in one piece, in many
def test_opaque_pixels_of_several_colours_are_told_at_any_width(tmp_path, columns):
    image = np.zeros((600, columns, 4), np.uint8)
    image[..., :3] = np.arange(600)[:, None, None] % 200
    image[:, : columns // 2, 3] = 255
    Image.fromarray(image).save(tmp_path / "a.png")
    with pytest.raises(DevrfError, match="colours and alpha channel differ"):
        _grey(tmp_path / "a.png", read_header(tmp_path / "a.png"))
