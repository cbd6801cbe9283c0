"""Images and optical flow on another raster: made smaller, interpolated, undistorted."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.scenes.lens import Lens
from devrf.scenes.validation import scene_error

Array = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.uint8]
# Pixels of some rows: a whole photograph would take a gigabyte in floating point.
_BAND = 2**14


@dataclass(frozen=True)
class Rows:
    """An 8-bit image of a ``shape`` (H, W, C), whose rows ``image[a:b]`` are ``read(a, b)``."""

    shape: tuple[int, ...]
    read: Callable[[int, int], Pixels]

    def __getitem__(self, rows: slice) -> Pixels:
        return self.read(rows.start or 0, self.shape[0] if rows.stop is None else rows.stop)


def bands(image: Rows | Pixels | Array | Tensor) -> Iterator[slice]:
    """The rows of an image, a few at a time."""
    rows, columns = image.shape[:2]
    step = max(1, _BAND // columns)
    return (slice(first, min(first + step, rows)) for first in range(0, rows, step))


def area_average(image: Array, width: int, height: int) -> Array:
    """The mean of ``image`` (H, W, C ≤ 4) float32 over each cell of a coarser raster.

    Cells of the result (height, width, C) are W/width × H/height source pixels, fractions included.
    """
    mean = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(mean, dtype=np.float32).reshape(height, width, image.shape[2])


def shrink_pixels(
    image: Rows | Pixels, width: int, height: int, *, alpha_weighted: bool = True
) -> Pixels:
    """An 8-bit image averaged over areas, colours ``alpha_weighted`` or each channel by itself.

    Images (H, W, 1, 3 or 4) are uint8, their alpha not premultiplied; weighted colours are black
    where alpha is 0.
    """
    rows, _, channels = image.shape
    weighted = alpha_weighted and channels == 4
    mean = np.zeros((height, width, channels), np.float32)
    for band in bands(image):
        across = area_average(_values(image[band], weighted), width, band.stop - band.start)
        # The share of each row of the band in the cells that it lies in.
        cells = slice(band.start * height // rows, -(-band.stop * height // rows))
        edges = np.arange(cells.start, cells.stop + 1)[:, None] * (rows / height)
        row = np.arange(band.start, band.stop)
        share = (np.minimum(edges[1:], row + 1) - np.maximum(edges[:-1], row)).clip(min=0)
        share = np.float32(share * (height / rows))
        mean[cells] += np.tensordot(share, across, axes=1)
    return _pixels(mean, weighted)


def interpolate_pixels(image: Pixels, source: Array) -> Pixels:
    """An 8-bit image (H, W, 1, 3 or 4), bilinearly at ``source``; colours weighted by alpha.

    ``source`` (H', W', 2) is x, y in pixels of ``image``, where a pixel's centre is at i + 0.5.
    Alpha is not premultiplied; black where it is 0. Positions outside get the nearest pixel of the
    border.
    """
    weighted = image.shape[2] == 4
    values = _values(image, weighted)
    result = np.empty((*source.shape[:2], image.shape[2]), np.uint8)
    for band in bands(source):
        x, y = np.ascontiguousarray(np.moveaxis(source[band] - np.float32(0.5), 2, 0))
        part = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        result[band] = _pixels(np.asarray(part, np.float32).reshape(result[band].shape), weighted)
    return result


def _values(image: Pixels, weighted: bool) -> Array:
    """An 8-bit image as numbers, its colours times its alpha if they are ``weighted``."""
    values = image.astype(np.float32)
    if weighted:  # colours behind a zero alpha are arbitrary: premultiplied, they cannot bleed in
        values[..., :3] *= values[..., 3:]
    return values


def _pixels(values: Array, weighted: bool) -> Pixels:
    """The 8-bit image of filtered :func:`_values`, rounded."""
    if weighted:
        color, alpha = values[..., :3], values[..., 3:]
        values[..., :3] = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    return (values + 0.5).clip(0, 255).astype(np.uint8)


def shrink_flow(
    vectors: Array, valid: npt.NDArray[np.bool_], width: int, height: int
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Optical flow (H, W, 2) of a smaller image of ``width`` × ``height`` pixels, x then y.

    Returns:
        vectors (height, width, 2) in pixels of the small image, the mean of the ``valid`` (H, W)
        ones with x scaled by width/W and y by height/H; and valid (height, width), true where at
        least half of the area was. Vectors are 0 where not valid.
    """
    rows, columns = valid.shape
    weight = valid.astype(np.float32)[..., None]
    mean = area_average(np.concatenate([vectors * weight, weight], axis=-1), width, height)
    trusted = mean[..., 2] >= 0.5 - 1e-6
    scale = np.asarray([width / columns, height / rows], dtype=np.float32)
    share = np.where(trusted, mean[..., 2], 1)[..., None]
    shrunk = np.where(trusted[..., None], mean[..., :2] / share * scale, 0)
    return shrunk.astype(np.float32), trusted


# A lens that has to be zoomed by more than this to fill its image counts as folded.
_LONGEST = 2.0
_STEPS = 2**24


def as_pinhole(
    pixels: Tensor,
    lenses: Sequence[Lens],
    names: Sequence[object],
    sizes: Sequence[tuple[int, int]],
) -> tuple[Tensor, tuple[Lens, ...]]:
    """Undistort the images that need it, bilinearly.

    The principal point stays, and the focal lengths grow just enough that the lens saw every pixel:
    there are no empty borders.

    Args:
        pixels: (N, H, W, 1, 3 or 4) uint8, alpha not premultiplied; changed in place.
        lenses: N, in pixels of these images; those returned have no distortion and skew.
        names: N, for messages.
        sizes: N (width, height) of the images, at the top left.

    Raises:
        DevrfError: a distortion is so strong that the image folds over.
    """
    plain = list(lenses)
    for row, lens in enumerate(lenses):
        if lens.pinhole:
            continue
        width, height = sizes[row]
        view = _pinhole_view(lens, width, height)
        if view is None:
            raise scene_error(
                names[row],
                "the distortion is so strong that the image folds over; undistort it first",
            )
        plain[row], source = view
        image = pixels[row, :height, :width]
        image.copy_(torch.from_numpy(interpolate_pixels(image.numpy(), source.numpy())))
    return pixels, tuple(plain)


# One lens for all images is the rule; several take turns at most.
@lru_cache(maxsize=4)
def _pinhole_view(lens: Lens, width: int, height: int) -> tuple[Lens, Tensor] | None:
    """The pinhole, and the lens's pixel (H, W, 2) of each of its pixels; None: folded."""
    source = _centres(width, height)
    zoom = _zoom(lens, source)
    if zoom is None:
        return None
    fx, fy = lens.focal
    center = lens.center
    plain = Lens((fx * zoom, fy * zoom), center)
    for band in bands(source):
        directions = _directions(plain, source[band].double())
        if not bool(lens.distortion.upright(directions).all()):
            return None
        source[band] = _on_lens(lens, directions).float()
    return plain, source


def _zoom(lens: Lens, centres: Tensor) -> float | None:
    """The least factor ≥ 1 of the focal lengths at which the lens saw the whole border."""
    height, width = centres.shape[:2]
    border = torch.cat([centres[0], centres[-1], centres[:, 0], centres[:, -1]]).double()
    directions = _directions(Lens(lens.focal, lens.center), border)
    size = border.new_tensor([width, height])

    def fills(zoom: float) -> bool:
        source = _on_lens(lens, directions / zoom)
        upright = lens.distortion.upright(directions / zoom)
        return bool((((source >= 0) & (source <= size)).all(dim=-1) & upright).all())

    def zoom(step: int) -> float:
        return 1 + (_LONGEST - 1) * step / _STEPS

    step = bisect_left(range(_STEPS + 1), True, key=lambda step: fills(zoom(step)))
    return None if step > _STEPS else zoom(step)


def _centres(width: int, height: int) -> Tensor:
    """(H, W, 2) float32 x, y of the pixels' centres."""
    x = torch.arange(width) + 0.5
    y = torch.arange(height) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


def _directions(pinhole: Lens, pixels: Tensor) -> Tensor:
    """(..., 2) x/z and y/z of a pinhole's ``pixels`` (..., 2)."""
    focal = pixels.new_tensor(pinhole.focal)
    center = pixels.new_tensor(pinhole.center)
    return (pixels - center) / focal


def _on_lens(lens: Lens, directions: Tensor) -> Tensor:
    """Pixels (..., 2) on which ``directions`` (..., 2) fall."""
    x, y = lens.distortion.distort(directions).unbind(-1)
    fx, fy = lens.focal
    cx, cy = lens.center
    return torch.stack([fx * x + lens.skew * y + cx, fy * y + cy], dim=-1)
