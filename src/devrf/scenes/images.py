"""Image files → uint8 tensors: found, measured before they are decoded, made smaller."""

from __future__ import annotations

import logging
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

from devrf.errors import DevrfError
from devrf.scenes.resampling import shrink_pixels
from devrf.scenes.validation import MAX_PIXELS, problem, reduced_size

log = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
# 16-bit and float greys have no fixed white; the rest converts to 8 bits without a choice.
DEEP_MODES = ("I", "F", "I;16", "I;16B", "I;16L", "I;16N")


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


def workers() -> int:
    """Threads for reading files: decoding leaves Python's lock, so a few do help."""
    return min(8, os.cpu_count() or 1)


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
    try:
        image = Image.open(path)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise problem(path, too_large) from None
    except Exception as error:
        raise _unreadable(path, error) from None
    if image.width * image.height > MAX_PIXELS:
        image.close()
        raise problem(path, too_large)
    return image


def _unreadable(path: Path, error: Exception) -> DevrfError:
    # Any exception: what decoders raise on damaged files depends on the format and the damage.
    reason = str(error) or type(error).__name__
    return problem(path, f"not a readable image ({reason}); replace the file")


def _header(path: Path) -> _Header:
    with _open(path) as image:
        if image.mode in DEEP_MODES:
            raise problem(path, f"expected 8 bits a channel, not mode {image.mode}; convert it")
        alpha = "A" in image.mode or "a" in image.mode or "transparency" in image.info
        return _Header(image.width, image.height, alpha)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file, from its header; else DevrfError."""
    header = _header(path)
    return header.width, header.height


def _decode(
    path: Path, header: _Header, alpha: bool, size: tuple[int, int]
) -> npt.NDArray[np.uint8]:
    with _open(path) as image:
        try:
            # An image without a matte in a set with mattes is opaque: WebP drops a full alpha.
            pixels = np.asarray(image.convert("RGBA" if alpha else "RGB"))
        except Exception as error:
            raise _unreadable(path, error) from None
    return pixels if size == (header.width, header.height) else shrink_pixels(pixels, *size)


def load_images(paths: Sequence[Path], downscale: int) -> Loaded:
    """Read images of one size, a few at a time.

    Args:
        paths: at least one existing file, 8 bits a channel, with or without alpha.
        downscale: integer factor ≥ 1; each side becomes floor(side / downscale), by area
            averages of premultiplied colours.

    Raises:
        DevrfError: a file cannot be read, is larger than 100 megapixels, differs in size from
            the first one, or would fall under 8 px a side.
    """
    start = time.perf_counter()
    with ThreadPoolExecutor(workers()) as pool:
        headers = list(pool.map(_header, paths))
        first = headers[0]
        for path, header in zip(paths, headers, strict=True):
            if (header.width, header.height) != (first.width, first.height):
                raise problem(
                    path,
                    f"{header.width}x{header.height} px, but {paths[0]} of the same set has "
                    f"{first.width}x{first.height} px; bring all images to one size",
                )
        size = reduced_size(first.width, first.height, downscale, paths[0])
        alpha = any(header.has_alpha for header in headers)
        # NumPy in the threads: each would otherwise start a team of torch threads of its own.
        pixels = np.empty((len(paths), size[1], size[0], 4 if alpha else 3), dtype=np.uint8)

        def fill(index: int) -> None:
            pixels[index] = _decode(paths[index], headers[index], alpha, size)

        for _ in pool.map(fill, range(len(paths))):
            pass
    log.info(
        "read %d images of %dx%d px from %s in %.1f s",
        len(paths), *size, paths[0].parent, time.perf_counter() - start,
    )
    return Loaded(torch.from_numpy(pixels), first.width, first.height)
