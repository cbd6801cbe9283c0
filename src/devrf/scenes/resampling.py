"""Images and optical flow on another raster: area averages, bilinear look-up."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.uint8]

# OpenCV addresses the pixels of an image to look up with 16 bits.
LONGEST_SIDE = 2**15 - 2


def area_average(image: Array, width: int, height: int) -> Array:
    """The mean of ``image`` over each cell of a coarser raster.

    Args:
        image: (H, W, C) float32, at most 4 channels.
        width: number of columns of the result, ≤ W; need not divide it.
        height: number of rows of the result, ≤ H; need not divide it.

    Returns:
        (height, width, C) float32; cells of W/width × H/height source pixels, fractions included.
    """
    mean = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(mean, dtype=np.float32).reshape(height, width, image.shape[2])


def shrink_pixels(image: Pixels, width: int, height: int) -> Pixels:
    """An 8-bit image averaged over areas; colours are weighted by their alpha.

    Args:
        image: (H, W, 1, 3 or 4) uint8, alpha not premultiplied.
        width: columns of the result.
        height: rows of the result.

    Returns:
        (height, width, 1, 3 or 4) uint8, alpha not premultiplied; black where alpha is 0.
    """
    return _weighted_by_alpha(image, lambda values: area_average(values, width, height))


def look_up_pixels(image: Pixels, source: Array) -> Pixels:
    """An 8-bit image looked up elsewhere, bilinearly; colours are weighted by their alpha.

    Args:
        image: (H, W, 1, 3 or 4) uint8, alpha not premultiplied; sides up to LONGEST_SIDE.
        source: (H', W', 2) x, y in pixels of ``image``, where a pixel's centre is at i + 0.5.

    Returns:
        (H', W', 1, 3 or 4) uint8, alpha not premultiplied; black where alpha is 0. Places outside
        take the nearest pixel of the border.
    """
    x, y = (np.ascontiguousarray(source[..., axis] - np.float32(0.5)) for axis in (0, 1))

    def looked_up(values: Array) -> Array:
        found = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, dtype=np.float32).reshape(*x.shape, image.shape[2])

    return _weighted_by_alpha(image, looked_up)


def _weighted_by_alpha(image: Pixels, linear: Callable[[Array], Array]) -> Pixels:
    """A linear filter of an 8-bit image, rounded."""
    values = image.astype(np.float32)
    if image.shape[2] != 4:
        found = linear(values)
    else:
        # Colours behind a zero alpha are arbitrary: premultiplied, they cannot bleed in.
        values[..., :3] *= values[..., 3:]
        found = linear(values)
        color, alpha = found[..., :3], found[..., 3:]
        found[..., :3] = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    return (found + 0.5).clip(0, 255).astype(np.uint8)


def shrink_flow(
    vectors: Array, valid: npt.NDArray[np.bool_], width: int, height: int
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Optical flow of a smaller image.

    Args:
        vectors: (H, W, 2) pixels of the large image, x then y.
        valid: (H, W) which of them to trust.
        width: columns of the result.
        height: rows of the result.

    Returns:
        vectors (height, width, 2) in pixels of the small image, the mean of the trusted ones
        with x scaled by width/W and y by height/H; and valid (height, width), true where at
        least half of the area was trusted. Vectors are 0 where not valid.
    """
    rows, columns = valid.shape
    weight = valid.astype(np.float32)[..., None]
    mean = area_average(np.concatenate([vectors * weight, weight], axis=-1), width, height)
    trusted = mean[..., 2] >= 0.5 - 1e-6
    scale = np.asarray([width / columns, height / rows], dtype=np.float32)
    share = np.where(trusted, mean[..., 2], 1)[..., None]
    shrunk = np.where(trusted[..., None], mean[..., :2] / share * scale, 0)
    return shrunk.astype(np.float32), trusted
