"""Image files → uint8 tensors: measured, turned if necessary, made smaller.

A photo may carry an EXIF orientation: viewers turn it, most tools that pose cameras do not. The
camera's size may tell them apart: an image is turned if only the turned one has the camera's
shape; otherwise it is read as it is stored.
"""

from __future__ import annotations

import io
import logging
import math
import os
import re
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path

import numpy as np
import torch
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import TILELENGTH, TILEWIDTH
from torch import Tensor

from devrf.scenes.files import decoding, entries
from devrf.scenes.resampling import Pixels, Rows, bands, shrink_pixels
from devrf.scenes.validation import check_memory, reduced_size, same_shape, scene_error

log = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
# Formats by content, not by name. Pillow reads many more, some by starting other programs.
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
# Suffixes of images in formats that are not read.
UNREAD = frozenset(
    ".heic .heif .avif .jxl .jp2 .exr .hdr .tga .ppm .gif .dng .cr2 .cr3 .nef .arw".split()
)
# Pillow warns of large images that it reads, and refuses those of twice that size; of damaged ones
# it warns, too, and what it cannot read is said in one line.
warnings.filterwarnings("ignore", module=r"PIL\.")
# 16-bit and float greys have no fixed white; the rest converts to 8 bits without a choice.
DEEP_MODES = ("I", "F", "I;16", "I;16B", "I;16L", "I;16N")
# The turn of a stored image, by its EXIF orientation; 1 is none.
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
# Turns that exchange width and height, and those after which the last row, or column, is the first.
QUARTER_TURNS = (5, 6, 7, 8)
FROM_THE_END = (3, 4, 7, 8)
# The most pixels of a TIFF's tile, which is decoded whole, however small the image.
LARGEST_TILE = 2**24
# The most scans of a progressive JPEG, each of which goes through all its pixels; usual are 10.
MOST_SCANS = 100
# The most reads of a file: a PNG has two for 8 kB or more, a BMP two for a run of one colour.
MOST_READS = 1_000_000
# Markers of a JPEG file, but for those within a scan.
MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
START_OF_SCAN = b"\xff\xda"
END_OF_IMAGE = b"\xff\xd9"

Size = tuple[float, float]


@dataclass(frozen=True)
class Header:
    """The stated properties of an image file.

    Attributes:
        width: columns of the image when it is read.
        height: its rows.
        has_alpha: whether it has an alpha channel.
        turn: the EXIF orientation by which it has to be turned; 1 is none.
        ambiguous_orientation: its EXIF orientation asks for a turn, and its camera neither
            confirms nor refutes it.
    """

    width: int
    height: int
    has_alpha: bool
    turn: int = 1
    ambiguous_orientation: bool = False


def unread(folder: Path) -> str:
    """The remedy for images in ``folder`` in formats that are not read; empty without any."""
    kinds = {path.suffix.lower() for path in entries(folder)} & UNREAD
    if not kinds:
        return ""
    return f"; {', '.join(sorted(kinds))} files are there, which are not read: convert them to PNG"


class _Parts(io.BufferedReader):
    """A file that is read in so many parts at most, for each of which Pillow takes a while."""

    reads = 0

    def __repr__(self) -> str:
        return repr(str(self.name))

    def read(self, size: int | None = -1, /) -> bytes:
        """The next bytes; ValueError: they are one part too many."""
        self.reads += 1
        if self.reads > MOST_READS:
            raise ValueError("too many parts")
        return super().read(size)


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """The image at ``path``, its header read, nothing decoded yet."""
    with ExitStack() as opened:
        with decoding(path, "image", "replace the file, or make it smaller"):
            # Of a file without a name Pillow maps nothing; of turned TIFFs it maps wrong rows.
            file = opened.enter_context(_Parts(io.FileIO(path)))
            image = Image.open(file, formats=FORMATS)
            tags = getattr(image, "tag_v2", {})
            if tags.get(TILEWIDTH, 0) * tags.get(TILELENGTH, 0) > LARGEST_TILE:
                raise ValueError("its tiles are too large")
            if "progressive" in image.info and _has_many_scans(path):
                raise ValueError(f"more than {MOST_SCANS} scans")
        yield image


def _has_many_scans(path: Path) -> bool:
    """Whether a JPEG file has more scans than MOST_SCANS; what follows its end is no part of it."""
    scans, place = 0, 2
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        while scans <= MOST_SCANS and (found := MARKER.search(data, place)):
            if found[0] == END_OF_IMAGE:
                break
            scans += found[0] == START_OF_SCAN
            place = found.end() + int.from_bytes(data[found.end() : found.end() + 2])
    return scans > MOST_SCANS


def read_header(path: Path, camera: Size | None = None) -> Header:
    """The stated properties of an image file.

    ``camera`` is the (width, height) of its camera's images; None: unknown. DevrfError if it is no
    image with 8 bits a channel, or too large for Pillow.
    """
    with open_image(path) as image:
        if image.mode in DEEP_MODES:
            raise scene_error(path, f"expected 8 bits a channel, not mode {image.mode}; convert it")
        alpha = "A" in image.mode or "a" in image.mode or "transparency" in image.info
        turn, ambiguous_orientation = _turn(_orientation(image), image.size, camera)
        width, height = image.size[::-1] if turn in QUARTER_TURNS else image.size
        return Header(width, height, alpha, turn, ambiguous_orientation)


def _orientation(image: Image.Image) -> int:
    """The EXIF orientation of an opened image, 1 if it has none that can be read."""
    stored = image.info.get("exif")
    if not isinstance(stored, bytes):
        return 1
    exif = Image.Exif()
    try:
        exif.load(stored)
        value = exif.get(ExifTags.Base.Orientation)
    # Any exception, as in decoding(); but damaged EXIF data do not spoil the picture.
    except Exception:
        return 1
    return value if isinstance(value, int) and value in TURNS else 1


def _turn(orientation: int, stored: Size, camera: Size | None) -> tuple[int, bool]:
    """The orientation to turn an image by, and whether it is in doubt."""
    if orientation == 1:
        return 1, False
    if camera is None:
        return 1, True
    turned = stored[::-1] if orientation in QUARTER_TURNS else stored
    as_stored = same_shape(stored, camera)
    as_seen = same_shape(turned, camera)
    if as_seen and not as_stored:
        return orientation, False
    return 1, as_seen == as_stored


def image_size(path: Path, camera: Size | None = None) -> tuple[int, int]:
    """(width, height) of an image file, from its header; see :func:`read_header`."""
    header = read_header(path, camera)
    return header.width, header.height


def decode(path: Path, header: Header, mode: str) -> Rows:
    """The pixels (H, W, …) of a file whose header has been read, in Pillow's mode RGB or RGBA.

    DevrfError if it is damaged, or contradicts its header.
    """
    with open_image(path) as image, decoding(path, "image", "replace the file"):
        image.load()
        columns = header.turn in QUARTER_TURNS
        if image.size[:: -1 if columns else 1] != (header.width, header.height):
            raise ValueError("its size is not the one that its header claims")

    def read(first: int, end: int) -> Pixels:
        # Turned part by part: a second whole picture would take as much memory as the first.
        if header.turn in FROM_THE_END:
            first, end = header.height - end, header.height - first
        box = (first, 0, end, image.height) if columns else (0, first, image.width, end)
        part = image.crop(box).convert(mode)
        return np.asarray(part.transpose(TURNS[header.turn]) if header.turn in TURNS else part)

    return Rows((header.height, header.width, len(mode)), read)


# Bytes of the images that are decoded at one time, at 8 bytes a pixel each.
_IN_FLIGHT = 2**30

# (position in the set, RGBA) → RGBA.
Finish = Callable[[int, Rows], Rows]


@dataclass(frozen=True)
class Loaded:
    """The images of one set.

    Attributes:
        pixels: (N, H, W, 3 or 4) uint8 after downscaling, alpha not premultiplied. H and W are
            those of the highest and of the widest; others are at the top left, beside them opaque
            black.
        files: N widths and heights of the files, before downscaling.
        sizes: N widths and heights after it.
        ambiguous_orientation: (N,) bool, images that are read as they are stored although their
            EXIF orientation asks for a turn, which nothing confirms or refutes.
    """

    pixels: Tensor
    files: list[tuple[int, int]]
    sizes: list[tuple[int, int]]
    ambiguous_orientation: Tensor


def raster_of(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The least (width, height) that holds each of some images."""
    return max(width for width, _ in sizes), max(height for _, height in sizes)


def in_threads(work: Callable[[int], object], items: Iterable[int], size: Size) -> None:
    """Do ``work`` for each item, a few at a time: decoding leaves Python's lock.

    ``size`` is the (width, height) of the images that it decodes.
    """
    most = _IN_FLIGHT // (8 * max(1, int(size[0] * size[1])))
    with ThreadPoolExecutor(max(1, min(8, os.cpu_count() or 1, most))) as pool:
        for _ in pool.map(work, items):
            pass


def load_images(
    paths: Sequence[Path],
    downscale: int,
    cameras: Sequence[Size | None] | None = None,
    finish: Finish | None = None,
    *,
    alpha_weighted: bool = True,
) -> Loaded:
    """Read images, a few at a time.

    Args:
        paths: at least one existing file, 8 bits a channel, with or without alpha.
        downscale: integer factor ≥ 1; each side becomes floor(side / downscale), by area averages.
        cameras: (width, height) of each camera's images, of any scale; None if it is unknown, for
            one image or for all.
        finish: maps the position and pixels of each image, as RGBA, to the pixels that are made
            smaller; images without alpha are opaque.
        alpha_weighted: whether colours are weighted by their alpha in these averages.

    Raises:
        DevrfError: a file cannot be read, or would fall under 8 px a side; or memory is too small
            for the images.
    """
    start = time.perf_counter()
    with ThreadPoolExecutor(8) as pool:
        headers = list(pool.map(read_header, paths, cameras or [None] * len(paths)))
    files = [(header.width, header.height) for header in headers]
    sizes = [
        reduced_size(header.width, header.height, downscale, path)
        for header, path in zip(headers, paths, strict=True)
    ]
    width, height = raster_of(sizes)
    several = len(set(sizes)) > 1
    alpha = finish is not None or any(header.has_alpha for header in headers)
    shape = (len(paths), height, width, 4 if alpha else 3)
    what = f"{len(paths)} images of {'several sizes up to ' * several}{width}x{height} px"
    check_memory(math.prod(shape), paths[0].parent, what)
    # NumPy in the threads: with torch each would start a team of threads of its own.
    pixels = np.empty(shape, dtype=np.uint8)
    if several:
        pixels[:] = 0
        pixels[..., 3:] = 255  # beside an image nothing is cut out

    def fill(index: int) -> None:
        # An image without alpha in a set with alpha is opaque: WebP drops a full alpha channel.
        image = decode(paths[index], headers[index], "RGBA" if alpha else "RGB")
        image = image if finish is None else finish(index, image)
        columns, rows = sizes[index]
        own = pixels[index, :rows, :columns]
        if sizes[index] == files[index]:
            for band in bands(own):
                own[band] = image[band]
        else:
            own[:] = shrink_pixels(image, columns, rows, alpha_weighted=alpha_weighted)

    in_threads(fill, range(len(paths)), raster_of(files))
    log.info("read %s from %s in %.1f s", what, paths[0].parent, time.perf_counter() - start)
    if turned := sum(header.turn != 1 for header in headers):
        log.info(
            "%d of them are turned as their EXIF orientation says, to fit their cameras",
            turned,
        )
    ambiguous_orientation = torch.tensor([header.ambiguous_orientation for header in headers])
    return Loaded(torch.from_numpy(pixels), files, sizes, ambiguous_orientation)
