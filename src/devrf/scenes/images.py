"""Image files → uint8 tensors: found, measured before they are decoded, made smaller."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from devrf.scenes.decoding import decoding
from devrf.scenes.memory import check_memory
from devrf.scenes.resampling import shrink_pixels
from devrf.scenes.validation import MAX_PIXELS, problem, reduced_size

log = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
# By content, not by name. Pillow reads many more formats, some by starting other programs.
FORMATS = ("PNG", "JPEG", "WEBP")
# 16-bit and float greys have no fixed white; the rest converts to 8 bits without a choice.
DEEP_MODES = ("I", "F", "I;16", "I;16B", "I;16L", "I;16N")
# What the images that are decoded at one time may take, at 8 bytes a pixel each.
_IN_FLIGHT = 2**30
# Bytes of images that a byte of their files can stand for: 1032 in PNG, 1536 in JPEG at the very
# most. An empty WebP image can do with less, but not all of a set that takes much memory.
_INFLATION = 2000
_MUCH = 2**28


@dataclass(frozen=True)
class Loaded:
    """The images of one set.

    Attributes:
        pixels: (N, H, W, 3 or 4) uint8 after downscaling, alpha not premultiplied.
        width: columns of the files, before downscaling.
        height: rows of the files, before downscaling.
    """

    pixels: Tensor
    width: int
    height: int


@dataclass(frozen=True)
class _Header:
    width: int
    height: int
    has_alpha: bool
    file_size: int


def workers(width: int, height: int) -> int:
    """Threads for files of such images: decoding leaves Python's lock, so a few do help."""
    return max(1, min(8, os.cpu_count() or 1, _IN_FLIGHT // (8 * max(1, width * height))))


def find_image(path: Path) -> Path:
    """The file at ``path``, or at ``path`` with an image suffix appended; else DevrfError."""
    candidates = [path.with_name(path.name + suffix) for suffix in SUFFIXES]
    if path.suffix.lower() in SUFFIXES:
        candidates.insert(0, path)
    for candidate in candidates:
        if os.path.isfile(candidate):  # Path.is_file raises on names that are too long
            return candidate
    raise problem(
        path, f"no such image (looked for {', '.join(SUFFIXES)}); correct file_path or add the file"
    )


def _open(path: Path) -> Image.Image:
    """The image at ``path``, its header read and its size accepted, nothing decoded yet."""
    too_large = f"the image claims more than {MAX_PIXELS // 10**6} megapixels; make it smaller"
    with decoding(path, "image", "replace the file"):
        try:
            image = Image.open(path, formats=FORMATS)
        except (Image.DecompressionBombError, Image.DecompressionBombWarning):
            raise problem(path, too_large) from None
    if image.width * image.height > MAX_PIXELS:
        image.close()
        raise problem(path, too_large)
    return image


def _header(path: Path) -> _Header:
    with _open(path) as image:
        if image.mode in DEEP_MODES:
            raise problem(path, f"expected 8 bits a channel, not mode {image.mode}; convert it")
        alpha = "A" in image.mode or "a" in image.mode or "transparency" in image.info
        return _Header(image.width, image.height, alpha, os.path.getsize(path))


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file, from its header; else DevrfError."""
    header = _header(path)
    return header.width, header.height


def _decode(
    path: Path, header: _Header, alpha: bool, size: tuple[int, int]
) -> npt.NDArray[np.uint8]:
    with _open(path) as image, decoding(path, "image", "replace the file"):
        # An image without a matte in a set with mattes is opaque: WebP drops a full alpha.
        pixels = np.asarray(image.convert("RGBA" if alpha else "RGB"))
        if pixels.shape[:2] != (header.height, header.width):
            raise ValueError("its size is not the one that its header claims")
    return pixels if size == (header.width, header.height) else shrink_pixels(pixels, *size)


def load_images(paths: Sequence[Path], downscale: int) -> Loaded:
    """Read images of one size, a few at a time, as they are stored: no file turns its own image.

    Args:
        paths: at least one existing file, 8 bits a channel, with or without alpha.
        downscale: integer factor ≥ 1; each side becomes floor(side / downscale), by area
            averages of premultiplied colours.

    Raises:
        DevrfError: a file cannot be read, is larger than 100 megapixels, differs in size from
            the first one, or would fall under 8 px a side; or there are more than fit into
            memory.
    """
    start = time.perf_counter()
    headers = _headers(paths)
    first = headers[0]
    size = reduced_size(first.width, first.height, downscale, paths[0])
    alpha = any(header.has_alpha for header in headers)
    shape = (len(paths), size[1], size[0], 4 if alpha else 3)
    _check_size(math.prod(shape), headers, f"{len(paths)} images of {size[0]}x{size[1]} px", paths)
    # NumPy in the threads: each would otherwise start a team of torch threads of its own.
    pixels = np.empty(shape, dtype=np.uint8)

    def fill(index: int) -> None:
        pixels[index] = _decode(paths[index], headers[index], alpha, size)

    with ThreadPoolExecutor(workers(first.width, first.height)) as pool:
        for _ in pool.map(fill, range(len(paths))):
            pass
    log.info(
        "read %d images of %dx%d px from %s in %.1f s",
        len(paths), *size, paths[0].parent, time.perf_counter() - start,
    )
    return Loaded(torch.from_numpy(pixels), first.width, first.height)


def _check_size(
    needed: int, headers: Sequence[_Header], what: str, paths: Sequence[Path]
) -> None:
    """DevrfError when ``needed`` bytes are more than the files can hold, or than there is."""
    sizes = {path: header.file_size for path, header in zip(paths, headers, strict=True)}
    files = sum(sizes.values())
    if needed > max(_MUCH, _INFLATION * files):
        raise problem(
            paths[0].parent, f"{what} cannot come from files of {files} bytes in all; replace them"
        )
    check_memory(needed, paths[0].parent, what)


def _headers(paths: Sequence[Path]) -> list[_Header]:
    """What each file claims to be, nothing decoded; DevrfError unless all are of one size."""
    with ThreadPoolExecutor(workers(1, 1)) as pool:
        headers = list(pool.map(_header, paths))
    first = headers[0]
    for path, header in zip(paths, headers, strict=True):
        if (header.width, header.height) != (first.width, first.height):
            raise problem(
                path,
                f"{header.width}x{header.height} px, but {paths[0]} of the same set has "
                f"{first.width}x{first.height} px; bring all images to one size",
            )
    return headers
