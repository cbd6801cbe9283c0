"""Images through a lens become images of a pinhole camera: geometry, alpha masks, borders."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import torch

from devrf.errors import DevrfError
from devrf.geometry.cameras import Distortion
from devrf.scenes.lens import Lens
from devrf.scenes.resampling import (
    Rows,
    area_average,
    as_pinhole,
    interpolate_pixels,
    shrink_pixels,
)

BARREL = Distortion((-0.2, 0.05, 0.0, 0.0), (0.004, -0.006))
PINCUSHION = Distortion((0.15, 0.02, 0.01, 0.0), (-0.004, 0.003))
WIDTH, HEIGHT = 96, 64


@pytest.mark.parametrize(("distortion", "skew"), [(BARREL, 0.0), (PINCUSHION, 4.0)])
def test_straight_lines_come_out_straight(distortion, skew, lens_directions):
    """Each pixel shows its own direction: an image of x/z and y/z becomes one linear in them."""
    lens = Lens((70.0, 60.0), (50.0, 30.0), distortion, skew)
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    direction = lens_directions(lens, WIDTH, HEIGHT)
    coded = ((direction + 1.5) * 80).round().clamp(0, 255).to(torch.uint8)
    image = torch.cat([coded, coded[..., :1]], dim=-1)
    pixels, (plain,) = as_pinhole(image[None], [lens], ["image"], [(WIDTH, HEIGHT)])
    assert plain.pinhole and plain.center == lens.center
    zoom = plain.focal[0] / 70
    assert zoom == pytest.approx(plain.focal[1] / 60) and zoom >= 1
    expected = torch.stack(
        [(x + 0.5 - 50) / plain.focal[0], (y + 0.5 - 30) / plain.focal[1]], dim=-1
    )
    found = pixels[0, ..., :2].float() / 80 - 1.5
    # One of 80 steps a unit; the border clamps half a pixel.
    assert (found - expected).abs()[2:-2, 2:-2].max() < 1.1 / 80


def test_a_pincushion_is_zoomed_until_nothing_is_missing():
    _, (plain,) = as_pinhole(
        torch.zeros(1, HEIGHT, WIDTH, 3, dtype=torch.uint8),
        [Lens((70.0, 70.0), (48.0, 32.0), PINCUSHION)],
        ["image"],
        [(WIDTH, HEIGHT)],
    )
    corner = torch.tensor([47.5, 31.5]) / plain.focal[0]
    reached = PINCUSHION.distort(corner) * 70
    assert plain.focal[0] > 70 and (reached <= torch.tensor([48.0, 32.0])).all()


def test_colours_behind_the_matte_do_not_bleed_in():
    image = np.array([[[200, 100, 50, 255], [0, 255, 0, 0]]], dtype=np.uint8)
    places = np.array([[[1.0, 0.5], [1.5, 0.5], [0.5, 0.5]]], dtype=np.float32)
    between = interpolate_pixels(image, places)
    assert between[0].tolist() == [[200, 100, 50, 128], [0, 0, 0, 0], [200, 100, 50, 255]]


def test_half_of_an_image_by_alpha_and_each_channel_by_itself():
    image = np.array([[[200, 100, 50, 255], [0, 255, 0, 0]]] * 2, dtype=np.uint8)
    assert shrink_pixels(image, 1, 1).tolist() == [[[200, 100, 50, 128]]]
    # Whatever is behind a zero alpha counts as much: (200 + 0) / 2, (100 + 255) / 2, 25, 127.5.
    assert shrink_pixels(image, 1, 1, alpha_weighted=False).tolist() == [[[100, 178, 25, 128]]]


@pytest.mark.parametrize("size", [(499, 399), (250, 200), (151, 33), (1, 1)])
def test_a_large_image_is_averaged_a_few_rows_at_a_time(size):
    image = np.random.default_rng(0).integers(0, 256, (400, 500, 3), dtype=np.uint8)
    expected = area_average(image.astype(np.float32), *size)
    asked = []

    def read(first: int, end: int) -> np.ndarray:
        asked.append(end - first)
        return image[first:end]

    shrunk = shrink_pixels(Rows(image.shape, read), *size).astype(np.float32)
    assert np.abs(shrunk - expected).max() < 0.501
    assert sum(asked) == 400 and max(asked) < 50
    assert np.array_equal(shrink_pixels(image, *size), shrunk)


def test_a_lens_that_folds_is_an_error_that_names_the_image():
    folded = Lens((12.0, 12.0), (48.0, 32.0), Distortion((-3.0, 0.0, 0.0, 0.0)))
    image = torch.zeros(1, HEIGHT, WIDTH, 3, dtype=torch.uint8)
    with pytest.raises(DevrfError, match=r"view_7\.png"):
        as_pinhole(image, [folded], ["view_7.png"], [(WIDTH, HEIGHT)])


def test_of_a_large_image_few_rows_are_interpolated_at_a_time():
    image = np.zeros((1000, 1000, 3), np.uint8)
    source = np.full((1000, 1000, 2), 7, np.float32)
    tracemalloc.start()
    try:
        assert not interpolate_pixels(image, source).any()
        # The image in floating point and the result; 50 MB were all rows taken at once.
        assert tracemalloc.get_traced_memory()[1] < 18e6
    finally:
        tracemalloc.stop()
