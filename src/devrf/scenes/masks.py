"""Masks beside images (nerfstudio's ``mask_path``): black pixels are left out, white ones kept.

Black pixels are either to be ignored (a passer-by, a tripod: nerfstudio's meaning) or known to be
background (everything around a person). The user says which, the files do not.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.scenes.images import (
    Finish,
    Header,
    Size,
    decode,
    in_threads,
    raster_of,
    read_header,
)
from devrf.scenes.lens import Lens
from devrf.scenes.resampling import Pixels, Rows, as_pinhole, bands, shrink_pixels
from devrf.scenes.validation import check_memory, scene_error
from devrf.system.options import abbreviated

log = logging.getLogger(__name__)

# ignore: pixels left out are neither learned from nor scored; alpha: they are background.
Masks = Literal["ignore", "alpha", "none"]

Grey = npt.NDArray[np.uint8]

WHITE = 255
# Pixels darker than half white are left out; compression makes edges grey.
HALF = 127
# Levels by which the channels of a grey image may differ, as JPEG's do.
GREY_NOISE = 16


def white_in(masks: Iterable[Grey], where: object) -> int:
    """The value of white in a set of masks: 255, or 1 if they are labels 0 and 1.

    One mask alone does not determine it: a frame without its subject is black, up to noise.
    DevrfError if no value of any is nearer to white than to black, and they are no such labels.
    """
    values = set[int]()
    for mask in masks:
        if int(mask.max()) > HALF:
            return WHITE
        values.update(np.unique(mask).tolist())
    if max(values) > 1:
        raise scene_error(
            where,
            f"masks of labels {abbreviated(sorted(values))[1:-1]}, expected black and white; make "
            "the labels that are to be kept 255, and the others 0",
        )
    return max(values) or WHITE


def white_in_files(paths: Sequence[Path]) -> int:
    """:func:`white_in` mask files; DevrfError, too, if one is no mask."""
    return white_in((_grey(path, read_header(path)) for path in paths), paths[0].parent)


def read_mask(
    path: Path, image: tuple[int, int], camera: Size | None, name: object, white: int
) -> Grey:
    """One mask (H, W) uint8, at the size of its image.

    Args:
        path: a file of 8 bits a channel that is grey, or whose alpha channel is the mask.
        image: (width, height) of the image's file.
        camera: (width, height) of its camera's images; the mask may have that size, too.
        name: the image, for messages.
        white: the value in the file that becomes 255, by :func:`white_in_files`.

    Raises:
        DevrfError: the file cannot be read, has another size, or is no mask.
    """
    header = read_header(path, image)
    size = (header.width, header.height)
    full = camera is not None and size == camera and size[0] >= image[0] and size[1] >= image[1]
    if size != image and not full:
        raise scene_error(
            path,
            f"{size[0]}x{size[1]} px, but its image {name} has {image[0]}x{image[1]} px; resize it",
        )
    grey = _grey(path, header) * np.uint8(WHITE // white)
    if size != image:
        grey = shrink_pixels(grey[..., None], image[0], image[1])[..., 0]
    return grey


def _grey(path: Path, header: Header) -> Grey:
    """The values (H, W) of a mask in its file."""
    pixels = decode(path, header, "RGBA")
    by_alpha = any(int(pixels[band][..., 3].min()) < WHITE for band in bands(pixels))
    # An alpha mask: its opaque pixels have one colour, or are as light as they are opaque.
    plain = not by_alpha or _is_plain(pixels)
    grey = np.empty(pixels.shape[:2], np.uint8)
    for band in bands(pixels):
        colors, alpha = np.split(pixels[band], [3], axis=2)
        grey[band] = (alpha if by_alpha else colors)[..., 0]
        if not by_alpha and int(np.ptp(colors, axis=2).max()) > GREY_NOISE:
            raise scene_error(path, "a mask with colours; give one channel, black and white")
        if not plain and np.abs(colors - alpha.astype(np.int16)).max() > GREY_NOISE:
            what = "a mask whose colours and alpha channel differ; give one channel"
            raise scene_error(path, what)
    return grey


def _is_plain(pixels: Rows) -> bool:
    """Whether all pixels of an RGBA image that are not transparent have one colour."""
    least, most = np.full(3, WHITE), np.zeros(3, int)
    for band in bands(pixels):
        opaque = pixels[band][pixels[band][..., 3] > 0][:, :3]
        if len(opaque):
            least = np.minimum(least, opaque.min(axis=0))
            most = np.maximum(most, opaque.max(axis=0))
    return bool((most - least).max() <= GREY_NOISE)


def cutting_out(
    paths: Sequence[Path | None], cameras: Sequence[Size | None], names: Sequence[Path]
) -> Finish | None:
    """The function that limits the alpha of images by their masks; None: no masks.

    Arguments are those of :func:`valid_pixels`; DevrfError if only some images have a mask.
    """
    masks = [path for path in paths if path is not None]
    if not masks:
        return None
    if len(masks) < len(paths):
        raise scene_error(
            names[list(paths).index(None)],
            "has no mask_path although others have; with data.masks=alpha give every image a mask",
        )
    white = white_in_files(masks)
    log.info("masks of %d images are their alpha masks", len(masks))

    def finish(index: int, image: Rows) -> Rows:
        height, width = image.shape[:2]
        mask = read_mask(masks[index], (width, height), cameras[index], names[index], white)

        def read(first: int, end: int) -> Pixels:
            cut = image[first:end].copy()
            cut[..., 3] = np.minimum(cut[..., 3], mask[first:end])
            return cut

        return Rows(image.shape, read)

    return finish


def valid_pixels(
    paths: Sequence[Path | None],
    images: Sequence[tuple[int, int]],
    sizes: Sequence[tuple[int, int]],
    cameras: Sequence[Size | None],
    lenses: Sequence[Lens],
    names: Sequence[Path],
) -> Tensor | None:
    """Mask (N, H, W) of the valid pixels, after downscaling and undistortion; None: all of them.

    A pixel is valid if all of its source pixels are. Pixels beside an image that is smaller than
    others are not.

    Args:
        paths: N masks, None for an image that is valid as a whole; or empty.
        images: N (width, height) of the images' files.
        sizes: N (width, height) after downscaling.
        cameras: N sizes of the cameras' images, or None.
        lenses: N, in pixels of the smaller images, before undistortion.
        names: N images, for messages.

    Raises:
        DevrfError: as of :func:`read_mask`; or a mask leaves nothing, or memory is too small.
    """
    masked = [k for k, path in enumerate(paths) if path is not None]
    if not masked and len(set(sizes)) == 1:
        return None
    width, height = raster_of(sizes)
    check_memory(len(sizes) * width * height, names[0].parent, f"{len(sizes)} masks")
    masks = np.zeros((len(sizes), height, width, 1), dtype=np.uint8)
    for mask, (columns, rows) in zip(masks, sizes, strict=True):
        mask[:rows, :columns] = WHITE
    files = [path for path in paths if path is not None]
    white = white_in_files(files) if files else WHITE

    def fill(k: int) -> None:
        path = paths[k]
        assert path is not None
        light = read_mask(path, images[k], cameras[k], names[k], white) > HALF
        sharp = light[..., None].astype(np.uint8) * np.uint8(WHITE)
        columns, rows = sizes[k]
        whole = sizes[k] == images[k]
        masks[k, :rows, :columns] = sharp if whole else shrink_pixels(sharp, columns, rows)

    in_threads(fill, masked, raster_of(images))
    pixels, _ = as_pinhole(torch.from_numpy(masks), lenses, names, sizes)
    valid_mask = pixels[..., 0] == WHITE
    for k in masked:
        if not bool(valid_mask[k].any()):
            raise scene_error(
                paths[k], f"leaves nothing of {names[k]} to learn from; leave the image out"
            )
    if masked:
        share = 100 - 100 * int(valid_mask.sum()) / sum(columns * rows for columns, rows in sizes)
        log.info("masks of %d images leave out %.1f %% of the pixels of all", len(masked), share)
    return valid_mask
