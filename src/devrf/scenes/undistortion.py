"""Images taken through a lens become images of a pinhole camera."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from devrf.scenes.lens import Lens
from devrf.scenes.resampling import LONGEST_SIDE, look_up_pixels
from devrf.scenes.validation import scene_error

# A lens that has to be zoomed by more than this to fill its image is given up as folded.
_LONGEST = 2.0
_HALVINGS = 24


def as_pinhole(
    pixels: Tensor, lenses: Sequence[Lens], names: Sequence[object]
) -> tuple[Tensor, tuple[Lens, ...]]:
    """Undistort the images that need it, bilinearly.

    The principal point stays and the focal lengths grow just enough that every pixel has been
    seen by the lens: there are no empty borders to learn from.

    Args:
        pixels: (N, H, W, 1, 3 or 4) uint8, alpha not premultiplied; changed in place.
        lenses: N, in pixels of these images.
        names: N, for messages.

    Returns:
        The pixels, and N lenses without distortion and skew.

    Raises:
        DevrfError: a distortion is so strong that the image folds over, or the image is wider
            or higher than 32,766 px.
    """
    height, width = pixels.shape[1:3]
    plain = list(lenses)
    for row, lens in enumerate(lenses):
        if lens.pinhole:
            continue
        if max(width, height) > LONGEST_SIDE:
            raise scene_error(
                names[row],
                f"{width}x{height} px, at most {LONGEST_SIDE} px a side can be undistorted; "
                "use a larger data.downscale",
            )
        view = _pinhole_view(lens, width, height)
        if view is None:
            raise scene_error(
                names[row],
                "the distortion (k1, k2, k3, p1, p2) is so strong that the image "
                "folds over; correct it, or undistort the images first",
            )
        plain[row], source = view
        pixels[row] = torch.from_numpy(look_up_pixels(pixels[row].numpy(), source.numpy()))
    return pixels, tuple(plain)


# One lens for all images is the rule; several take turns at most.
@lru_cache(maxsize=4)
def _pinhole_view(lens: Lens, width: int, height: int) -> tuple[Lens, Tensor] | None:
    """The pinhole and, for each of its pixels, where the lens has it (H, W, 2); None: folded."""
    centres = _centres(width, height)
    zoom = _zoom(lens, centres)
    if zoom is None:
        return None
    (fx, fy), center = lens.focal, lens.center
    plain = Lens((fx * zoom, fy * zoom), center)
    directions = _directions(plain, centres)
    if not bool(lens.distortion.upright(directions).all()):
        return None
    return plain, _on_lens(lens, directions).float()


def _zoom(lens: Lens, centres: Tensor) -> float | None:
    """The least factor ≥ 1 of the focal lengths at which the lens saw the whole border."""
    height, width = centres.shape[:2]
    border = torch.cat([centres[0], centres[-1], centres[:, 0], centres[:, -1]])
    directions = _directions(Lens(lens.focal, lens.center), border)
    size = border.new_tensor([width, height])

    def seen(zoom: float) -> bool:
        source = _on_lens(lens, directions / zoom)
        upright = lens.distortion.upright(directions / zoom)
        return bool((((source >= 0) & (source <= size)).all(dim=-1) & upright).all())

    if seen(1.0):
        return 1.0
    low, high = 1.0, _LONGEST
    if not seen(high):
        return None
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if seen(middle) else (middle, high)
    return high


def _centres(width: int, height: int) -> Tensor:
    """(H, W, 2) float64 x, y of the pixels' centres."""
    x, y = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).double()


def _directions(pinhole: Lens, pixels: Tensor) -> Tensor:
    """(..., 2) x/z and y/z of a pinhole's ``pixels`` (..., 2)."""
    focal, center = pixels.new_tensor(pinhole.focal), pixels.new_tensor(pinhole.center)
    return (pixels - center) / focal


def _on_lens(lens: Lens, directions: Tensor) -> Tensor:
    """Pixels (..., 2) on which ``directions`` (..., 2) fall."""
    x, y = lens.distortion.distort(directions).unbind(-1)
    (fx, fy), (cx, cy) = lens.focal, lens.center
    return torch.stack([fx * x + lens.skew * y + cx, fy * y + cy], dim=-1)
