"""Sets of image files → uint8 tensors: measured before they are decoded, made smaller."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.scenes.image_files import Header, Size, decode, read_header
from devrf.scenes.memory import check_memory
from devrf.scenes.resampling import shrink_pixels
from devrf.scenes.validation import reduced_size, scene_error

log = logging.getLogger(__name__)

# What the images that are decoded at one time may take, at 8 bytes a pixel each.
_IN_FLIGHT = 2**30
# Bytes of images that a byte of their files can stand for: 1032 in PNG, 1536 in JPEG at the very
# most. An empty WebP image can do with less, but not all of a set that takes much memory.
_INFLATION = 2000
_MUCH = 2**28

# (position in the set, RGBA) → RGBA.
Finish = Callable[[int, npt.NDArray[np.uint8]], npt.NDArray[np.uint8]]


@dataclass(frozen=True)
class Loaded:
    """The images of one set.

    Attributes:
        pixels: (N, H, W, 3 or 4) uint8 after downscaling, alpha not premultiplied.
        width: columns of the files, before downscaling.
        height: rows of the files, before downscaling.
        ambiguous_orientation: (N,) bool, images that are read as they are stored although their
            EXIF orientation asks for a turn, which nothing confirms or refutes.
    """

    pixels: Tensor
    width: int
    height: int
    ambiguous_orientation: Tensor


def workers(width: int, height: int) -> int:
    """Threads for files of such images: decoding leaves Python's lock, so a few do help."""
    return max(1, min(8, os.cpu_count() or 1, _IN_FLIGHT // (8 * max(1, width * height))))


def load_images(
    paths: Sequence[Path],
    downscale: int,
    cameras: Sequence[Size | None] | None = None,
    finish: Finish | None = None,
) -> Loaded:
    """Read images of one size, a few at a time.

    A file's EXIF orientation turns its image only where its camera asks for that
    (:mod:`devrf.scenes.image_files`).

    Args:
        paths: at least one existing file, 8 bits a channel, with or without alpha.
        downscale: integer factor ≥ 1; each side becomes floor(side / downscale), by area
            averages of premultiplied colours.
        cameras: (width, height) of the images that each camera is for, of any scale; None where
            it is unknown, or of all.
        finish: what to make of each RGBA image, by its position, before it is made smaller;
            images without alpha come to it opaque.

    Raises:
        DevrfError: a file cannot be read, is larger than 100 megapixels, differs in size from
            the first one, or would fall under 8 px a side; or there are more than fit into
            memory.
    """
    start = time.perf_counter()
    headers = _headers(paths, cameras or [None] * len(paths))
    first = headers[0]
    size = reduced_size(first.width, first.height, downscale, paths[0])
    alpha = finish is not None or any(header.has_alpha for header in headers)
    shape = (len(paths), size[1], size[0], 4 if alpha else 3)
    _check_size(math.prod(shape), headers, f"{len(paths)} images of {size[0]}x{size[1]} px", paths)
    # NumPy in the threads: each would otherwise start a team of torch threads of its own.
    pixels = np.empty(shape, dtype=np.uint8)

    def fill(index: int) -> None:
        # An image without alpha in a set with alpha is opaque: WebP drops a full alpha channel.
        image = decode(paths[index], headers[index], "RGBA" if alpha else "RGB")
        image = image if finish is None else finish(index, image)
        whole = size == (first.width, first.height)
        pixels[index] = image if whole else shrink_pixels(image, *size)

    with ThreadPoolExecutor(workers(first.width, first.height)) as pool:
        for _ in pool.map(fill, range(len(paths))):
            pass
    log.info(
        "read %d images of %dx%d px from %s in %.1f s",
        len(paths),
        *size,
        paths[0].parent,
        time.perf_counter() - start,
    )
    turned = sum(header.turn != 1 for header in headers)
    if turned:
        log.info(
            "%d of them turned as their EXIF orientation says: only so they fit their cameras",
            turned,
        )
    ambiguous_orientation = torch.tensor([header.ambiguous_orientation for header in headers])
    return Loaded(torch.from_numpy(pixels), first.width, first.height, ambiguous_orientation)


def _check_size(needed: int, headers: Sequence[Header], what: str, paths: Sequence[Path]) -> None:
    """DevrfError when ``needed`` bytes are more than the files can hold, or than there is."""
    sizes = {path: header.file_size for path, header in zip(paths, headers, strict=True)}
    files = sum(sizes.values())
    if needed > max(_MUCH, _INFLATION * files):
        raise scene_error(
            paths[0].parent, f"{what} cannot come from files of {files} bytes in all; replace them"
        )
    check_memory(needed, paths[0].parent, what)


def _headers(paths: Sequence[Path], cameras: Sequence[Size | None]) -> list[Header]:
    """What each file claims to be, nothing decoded; DevrfError unless all are of one size."""
    with ThreadPoolExecutor(workers(1, 1)) as pool:
        headers = list(pool.map(read_header, paths, cameras))
    first = headers[0]
    for path, header in zip(paths, headers, strict=True):
        if (header.width, header.height) != (first.width, first.height):
            raise scene_error(
                path,
                f"{header.width}x{header.height} px, but {paths[0]} of the same set has "
                f"{first.width}x{first.height} px; bring all images to one size",
            )
    return headers
