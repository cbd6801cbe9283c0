"""EXIF orientation: images are turned only where their cameras ask for that."""

from __future__ import annotations

import logging
import re
import struct
import tracemalloc
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from devrf.errors import DevrfError
from devrf.scenes.images import decode, image_size, load_images, read_header
from devrf.scenes.masks import read_mask, white_in_files

WIDE, HIGH = (24, 16), (16, 24)


def photo(path: Path, orientation: int, size=WIDE, seed: int = 0) -> Path:
    """A file that says how its image is to be seen."""
    values = np.random.default_rng(seed).integers(0, 255, (4, 4, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).resize(size, Image.Resampling.BILINEAR).save(path, exif=exif)
    return path


def pixels(path: Path, camera) -> np.ndarray:
    return decode(path, read_header(path, camera), "RGB")[:]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_image_is_turned_where_only_so_it_fits_its_camera(tmp_path, orientation):
    path = photo(tmp_path / f"a.{('jpg', 'png', 'webp')[orientation % 3]}", orientation)
    with Image.open(path) as image:
        stored, seen = np.asarray(image), np.asarray(ImageOps.exif_transpose(image))
    quarter = orientation >= 5
    # The camera may be one of an image four times as large.
    fits = (64.0, 96.0) if quarter else (96.0, 64.0)
    assert np.array_equal(pixels(path, fits), seen if quarter else stored)
    assert image_size(path, fits) == (HIGH if quarter else WIDE)
    # Half turns and mirrors leave the shape: nobody can tell.
    assert read_header(path, fits).ambiguous_orientation == (orientation in (2, 3, 4))
    # The camera is one of the image as it is stored.
    assert np.array_equal(pixels(path, WIDE), stored)
    assert read_header(path, WIDE).ambiguous_orientation == (orientation in (2, 3, 4))
    # No camera says anything, or all that it says fits neither.
    for unknown in (None, (300, 100)):
        assert np.array_equal(pixels(path, unknown), stored)
        assert read_header(path, unknown).ambiguous_orientation == (orientation != 1)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("compression", ["raw", "tiff_lzw"])
def test_a_tiff_is_turned_as_it_says(tmp_path, orientation, compression):
    values = np.random.default_rng(0).integers(0, 255, (*WIDE[::-1], 4), dtype=np.uint8)
    path, tag = tmp_path / "a.tif", {274: orientation}
    Image.fromarray(values).save(path, compression=compression, tiffinfo=tag)
    with Image.open(path.open("rb")) as image:
        seen = np.asarray(image)
    assert image_size(path) == (HIGH if orientation >= 5 else WIDE)
    assert np.array_equal(decode(path, read_header(path), "RGBA")[:], seen)


@pytest.mark.parametrize("orientation", range(5, 9))
def test_few_rows_are_turned_at_a_time(tmp_path, orientation, monkeypatch):
    path = photo(tmp_path / "a.png", orientation, (400, 300))
    with Image.open(path) as image:
        seen = np.asarray(ImageOps.exif_transpose(image))
    turned: list[int] = []
    transpose = Image.Image.transpose
    monkeypatch.setattr(
        Image.Image,
        "transpose",
        lambda self, way: turned.append(self.width * self.height) or transpose(self, way),
    )
    loaded = load_images([path], 1, [(300, 400)])
    assert np.array_equal(loaded.pixels[0].numpy(), seen)
    assert sum(turned) == 400 * 300 and max(turned) <= 2**14


def test_a_set_is_of_one_size_once_it_is_turned(tmp_path, caplog):
    paths = [photo(tmp_path / "0.jpg", 1), photo(tmp_path / "1.jpg", 6, HIGH)]
    with caplog.at_level(logging.INFO):
        loaded = load_images(paths, 2, [WIDE, WIDE])
    assert loaded.pixels.shape == (2, 8, 12, 3) and loaded.files == [WIDE, WIDE]
    assert not bool(loaded.ambiguous_orientation.any())
    assert "1 of them are turned as their EXIF orientation says" in caplog.text
    # Without cameras none is turned, and they are of two sizes.
    loaded = load_images(paths, 1)
    assert loaded.pixels.shape == (2, 24, 24, 3) and loaded.sizes == [WIDE, HIGH]
    assert np.array_equal(loaded.pixels[1, :, :16].numpy(), pixels(paths[1], None))
    assert not bool(loaded.pixels[0, 16:].any() | loaded.pixels[1, :, 16:].any())


def test_headers_are_read_without_a_change_of_the_filters_of_warnings(tmp_path, monkeypatch):
    """They belong to all threads: what one puts back is what another has changed."""
    path = photo(tmp_path / "a.jpg", 6, HIGH)
    with monkeypatch.context() as patched:
        patched.setattr(warnings, "catch_warnings", None)
        assert read_header(path, WIDE).turn == 6


def peak_of(work: Callable[[], object]) -> int:
    """Bytes that some work takes at most, but for those of decoded files."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
def test_of_a_large_image_few_rows_are_converted_at_a_time(tmp_path, mode):
    path = tmp_path / "large.png"
    Image.new(mode, (4000, 3000)).save(path)
    assert peak_of(lambda: load_images([path], 30)) < 4e6
    if mode == "L":  # as a mask it is kept whole, a byte a pixel
        mask = read_mask(path, (4000, 3000), None, "an image", 1)
        assert not mask.any() and peak_of(lambda: white_in_files([path])) < 30e6


def test_a_tiff_of_a_small_image_in_large_tiles(tmp_path):
    path = tmp_path / "small.tif"
    for side in (256, 2**14):
        # Pillow writes no tiles: tags of its own take their names.
        Image.new("L", (64, 64)).save(path, tiffinfo={65322: side, 65323: side})
        content = path.read_bytes()
        for tag in (322, 323):
            content = content.replace(struct.pack("<H", 65000 + tag), struct.pack("<H", tag))
        path.write_bytes(content)
        if side == 256:
            assert image_size(path) == (64, 64)
    with pytest.raises(DevrfError, match="its tiles are too large"):
        read_header(path)


def test_a_jpeg_of_any_number_of_scans(tmp_path):
    path = tmp_path / "a.jpg"
    Image.new("RGB", (64, 64)).save(path, progressive=True)
    content = path.read_bytes()
    assert image_size(path) == (64, 64)
    path.write_bytes(content[:-2] + content[content.rfind(b"\xff\xda") : -2] * 100 + content[-2:])
    with pytest.raises(DevrfError, match="more than 100 scans"):
        read_header(path)
    path.write_bytes(content + b"\xff\xda" * 200)  # as the film behind a phone's photograph
    assert image_size(path) == (64, 64)


@pytest.mark.parametrize(
    ("suffix", "place", "part"),
    [
        ("jpg", 2, b"\xff\xfe\x00\x02"),  # a comment without text
        ("jpg", 2, b"\xff\xd8"),
        ("jpg", 2, b"\xff\xf0\x00\x02"),
        ("jpg", 20, b"\0"),
        ("png", 33, struct.pack(">I4sI", 0, b"prIv", zlib.crc32(b"prIv"))),
    ],
)
def test_an_image_of_any_number_of_parts(tmp_path, monkeypatch, suffix, place, part):
    monkeypatch.setattr("devrf.scenes.images.MOST_READS", 1000)
    path = tmp_path / f"a.{suffix}"
    Image.new("RGB", (64, 64)).save(path)
    content = path.read_bytes()
    for count, fault in ((3, ""), (5000, "not a readable image (too many parts)")):
        path.write_bytes(content[:place] + part * count + content[place:])
        if fault:
            with pytest.raises(DevrfError, match=re.escape(fault)):
                image_size(path)
        else:
            assert image_size(path) == (64, 64)
    path.write_bytes(content + part * 5000)  # behind its end
    assert image_size(path) == (64, 64)


def test_nearly_square_images_are_turned_too(tmp_path):
    path = photo(tmp_path / "a.jpg", 6, (50, 48))
    assert image_size(path, (48, 50)) == (48, 50)
    assert not read_header(path, (48, 50)).ambiguous_orientation
