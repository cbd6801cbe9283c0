"""Masks beside images (nerfstudio's ``mask_path``): grey files, black where they leave out.

What a mask leaves out is either to be ignored (a passer-by, a tripod: nerfstudio's meaning) or
known to be background (everything around a person). A file does not say which; the user does.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.scenes.images import Finish, Size, decode, in_threads, read_header
from devrf.scenes.lens import Lens
from devrf.scenes.resampling import as_pinhole, shrink_pixels
from devrf.scenes.validation import check_memory, scene_error

log = logging.getLogger(__name__)

# ignore: pixels left out are neither learned from nor scored; alpha: they are background.
Masks = Literal["ignore", "alpha", "none"]

Grey = npt.NDArray[np.uint8]

WHITE = 255
# A pixel is left out that is darker than half white; compression leaves edges grey.
HALF = 127
# Levels by which the channels of a grey image may differ, as JPEG's do.
GREY_NOISE = 16


def read_mask(path: Path, image: tuple[int, int], camera: Size | None, name: object) -> Grey:
    """One mask (H, W) uint8, at the size of its image.

    Args:
        path: a file of 8 bits a channel that is grey and opaque. Labels 0 and 1 are black and
            white.
        image: (width, height) of the image's file.
        camera: (width, height) that its camera is for; a mask may be given at that size, too.
        name: the image, for messages.

    Raises:
        DevrfError: the file cannot be read, has another size, or is not grey.
    """
    header = read_header(path, image)
    size = (header.width, header.height)
    full = camera is not None and size == camera and size[0] >= image[0] and size[1] >= image[1]
    if size != image and not full:
        raise scene_error(
            path,
            f"{size[0]}x{size[1]} px, but its image {name} has {image[0]}x{image[1]} px; resize it",
        )
    pixels = decode(path, header, "RGBA")
    spread = pixels[..., :3].max(axis=2) - pixels[..., :3].min(axis=2)
    if int(spread.max()) > GREY_NOISE or int(pixels[..., 3].min()) < WHITE:
        raise scene_error(path, "a mask with colours or an alpha channel; give one channel")
    grey = np.ascontiguousarray(pixels[..., :1])
    if int(grey.max()) == 1:
        grey *= WHITE
    if size != image:
        grey = shrink_pixels(grey, image[0], image[1])
    return grey[..., 0]


def cutting_out(
    paths: Sequence[Path | None], cameras: Sequence[Size | None], names: Sequence[Path]
) -> Finish | None:
    """What makes masks the alpha of their images, the lesser of the two; None: no masks.

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
    log.info("masks of %d images are their alpha masks", len(masks))

    def finish(index: int, image: Grey) -> Grey:
        height, width = image.shape[:2]
        mask = read_mask(masks[index], (width, height), cameras[index], names[index])
        cut = image.copy()
        cut[..., 3] = np.minimum(image[..., 3], mask)
        return cut

    return finish


def valid_pixels(
    paths: Sequence[Path | None],
    image: tuple[int, int],
    size: tuple[int, int],
    cameras: Sequence[Size | None],
    lenses: Sequence[Lens],
    names: Sequence[Path],
) -> Tensor | None:
    """Which pixels (N, H, W) are valid, after downscaling and undistortion; None: all of them.

    A pixel is valid if all source pixels that it is made of are.

    Args:
        paths: N masks; None for an image that is valid as a whole.
        image: (width, height) of the images' files.
        size: (width, height) after downscaling.
        cameras: N sizes that the cameras are for, or None.
        lenses: N, in pixels of the smaller images, before undistortion.
        names: N images, for messages.

    Raises:
        DevrfError: what :func:`read_mask` raises, a mask leaves nothing, or there is too little
            memory.
    """
    masked = [k for k, path in enumerate(paths) if path is not None]
    if not masked:
        return None
    width, height = size
    check_memory(len(paths) * width * height, names[0].parent, f"{len(masked)} masks")
    masks = np.full((len(paths), height, width, 1), WHITE, dtype=np.uint8)

    def fill(k: int) -> None:
        path = paths[k]
        assert path is not None
        light = read_mask(path, image, cameras[k], names[k]) > HALF
        sharp = light[..., None].astype(np.uint8) * np.uint8(WHITE)
        masks[k] = sharp if size == image else shrink_pixels(sharp, width, height)

    in_threads(fill, masked, image)
    pixels, _ = as_pinhole(torch.from_numpy(masks), lenses, names)
    valid_mask = pixels[..., 0] == WHITE
    for k in masked:
        if not bool(valid_mask[k].any()):
            raise scene_error(
                paths[k], f"leaves nothing of {names[k]} to learn from; leave the image out"
            )
    share = 100 * float((~valid_mask).float().mean())
    log.info("masks of %d images leave out %.1f %% of the pixels of all", len(masked), share)
    return valid_mask
