"""The video of a scene at rest: its held-out views one after the other, beside the truth."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from devrf.artifacts.film import FilmSettings
from devrf.artifacts.images import side_by_side
from devrf.evaluation.held_out import background_value, truth_image
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Background, Views


def turns(views: int, frames: int) -> list[int]:
    """Which of the views each of so many frames shows: all in order, for the same time each.

    Of more views than frames an even choice is shown.
    """
    return [frame * views // frames for frame in range(frames)]


def beside_truth(
    renderer: Renderer, views: Views, background: Background, film: FilmSettings
) -> Iterator[Tensor]:
    """What is rendered at each held-out camera in turn, beside the image that was taken there.

    Yields:
        (H, 2W + gap, 3) in [0, 1]: the truth, then the rendering.
    """
    cameras, shown, picture = film.sized(views.cameras), -1, torch.empty(0)
    shape = (cameras.height, cameras.width)
    for view in turns(len(views), film.frames):
        if view != shown:
            seen = renderer.view(cameras, view, 0.0, background_value(background))
            truth = _resized(truth_image(views, view, background), shape)
            picture = side_by_side([truth, seen.color.view(*shape, 3).clamp(0, 1).cpu()])
            shown = view
        yield picture


def _resized(image: Tensor, shape: tuple[int, int]) -> Tensor:
    """An image (H, W, 3) at another size; smooth where it is enlarged."""
    if tuple(image.shape[:2]) == shape:
        return image
    planes = image.permute(2, 0, 1)[None]
    resized = interpolate(planes, shape, mode="bicubic", antialias=True, align_corners=False)
    return resized[0].permute(1, 2, 0).clamp(0, 1)
