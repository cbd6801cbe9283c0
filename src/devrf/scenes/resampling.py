"""Making images and optical flow smaller by exact area averages."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]


def _averaged(values: Array, target: int) -> Array:
    """Means (target, …) of ``values`` (size, …) over ``target`` equal stretches of its first axis.

    Differences of the running integral at the stretches' ends, which need not fall on cells.
    """
    size = len(values)
    integral = np.zeros((size + 1, *values.shape[1:]))
    np.cumsum(values, axis=0, dtype=np.float64, out=integral[1:])
    ends = np.linspace(0, size, target + 1)
    cell = np.minimum(ends.astype(np.int64), size - 1)
    share = (ends - cell).reshape(-1, *[1] * (values.ndim - 1))
    at_ends = integral[cell] * (1 - share) + integral[cell + 1] * share
    return np.asarray(np.diff(at_ends, axis=0) * (target / size), dtype=np.float32)


def area_average(image: Array, width: int, height: int) -> Array:
    """The mean of ``image`` over each cell of a coarser raster.

    Args:
        image: (H, W, C) float32.
        width: number of columns of the result, ≤ W; need not divide it.
        height: number of rows of the result, ≤ H; need not divide it.

    Returns:
        (height, width, C) float32; cells of W/width × H/height source pixels, fractions counted.
    """
    rows, columns, channels = image.shape
    if rows % height == 0 and columns % width == 0:
        cells = image.reshape(height, rows // height, width, columns // width, channels)
        return np.asarray(cells.mean(axis=(1, 3), dtype=np.float32))
    return _averaged(_averaged(image, height).swapaxes(0, 1), width).swapaxes(0, 1)


def shrink_pixels(image: npt.NDArray[np.uint8], width: int, height: int) -> npt.NDArray[np.uint8]:
    """An 8-bit image averaged over areas; colours count by their alpha.

    Args:
        image: (H, W, 1, 3 or 4) uint8, alpha not premultiplied.
        width: columns of the result.
        height: rows of the result.

    Returns:
        (height, width, 1, 3 or 4) uint8, alpha not premultiplied; black where alpha is 0.
    """
    values = image.astype(np.float32)
    if image.shape[2] == 4:
        # Colours behind a zero alpha are arbitrary: premultiplied, they cannot bleed in.
        values[..., :3] *= values[..., 3:]
        mean = area_average(values, width, height)
        alpha = mean[..., 3:]
        mean[..., :3] = np.divide(
            mean[..., :3], alpha, out=np.zeros_like(mean[..., :3]), where=alpha > 0
        )
    else:
        mean = area_average(values, width, height)
    return (mean + 0.5).clip(0, 255).astype(np.uint8)


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
