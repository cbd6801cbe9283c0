"""The encoder: the images of a moment → the distribution of its code."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from devrf.methods.neural_volumes.layers import LEAK, halving, linear
from devrf.scenes.scene import Views

# Colours are standardised as published: mean 100 and deviation 25 of 255.
MEAN, DEVIATION = 100 / 255, 25 / 255


class TimeEncoder(nn.Module):
    """K images of a moment → μ and log s of its code (docs/methods/neural_volumes.md#encoder)."""

    def __init__(
        self, views: int, size: Sequence[int], channels: Sequence[int], width: int, code: int
    ) -> None:
        """Build a stack of convolutions for each camera, and the layers that join them.

        Args:
            views: K cameras.
            size: height and width of an image.
            channels: of each convolution.
            width: units of the joining layer.
            code: numbers in a code.
        """
        super().__init__()
        stack = [3, *channels]
        self.cameras = nn.ModuleList()
        for _ in range(views):
            layers: list[nn.Module] = []
            for read, made in zip(stack, stack[1:], strict=False):
                layers += [halving(read, made), nn.LeakyReLU(LEAK)]
            self.cameras.append(nn.Sequential(*layers, nn.Flatten()))
        cells = (size[0] >> len(channels)) * (size[1] >> len(channels))
        joined = linear(views * channels[-1] * cells, width)
        self.joined = nn.Sequential(joined, nn.LeakyReLU(LEAK))
        self.mean, self.log_deviation = linear(width, code, 1.0), linear(width, code, 1.0)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """μ and log s, (M, code) each.

        Args:
            images: (M, K, 3, H, W) RGB in [0, 1].
        """
        standard = (images - MEAN) / DEVIATION
        seen = [camera(standard[:, k]) for k, camera in enumerate(self.cameras)]
        joined = self.joined(torch.cat(seen, dim=1))
        return 0.1 * self.mean(joined), 0.01 * self.log_deviation(joined)


def cameras_of_every_frame(views: Views) -> list[int]:
    """The fixed cameras that have an image of each frame that any camera has."""
    assert views.frames is not None
    seen: dict[int, set[int]] = {}
    for camera, frame in zip(views.view.tolist(), views.frames.tolist(), strict=True):
        seen.setdefault(camera, set()).add(frame)
    everything = set().union(*seen.values())
    return sorted(camera for camera, frames in seen.items() if frames == everything)


def moment_images(
    views: Views, cameras: Sequence[int], frames: int, size: Sequence[int], background: float
) -> Tensor:
    """What the encoder reads of each frame: (T, K, 3, h, w) uint8, on the host.

    Images larger than ``size`` are made smaller; what is left around them is the background. A
    frame that no camera has (time 0 of a capture that begins later) has the images of the next.

    Args:
        views: images with mattes.
        cameras: K numbers of fixed cameras.
        frames: T.
        size: height and width (h, w).
        background: grey level in [0, 1] behind the mattes.
    """
    assert views.frames is not None
    height, width = size
    scale = min(1.0, height / views.height, width / views.width)
    rows, columns = round(views.height * scale), round(views.width * scale)
    top, left = (height - rows) // 2, (width - columns) // 2
    images = torch.full(
        (frames, len(cameras), 3, height, width), round(255 * background), dtype=torch.uint8
    )
    first = int(views.frames.min())
    for k, camera in enumerate(cameras):
        for place in (views.view == camera).nonzero()[:, 0].tolist():
            pixels = views.pixels[place].permute(2, 0, 1).float() / 255
            color = background + pixels[3:] * (pixels[:3] - background)
            if scale < 1:
                color = nn.functional.interpolate(
                    color[None], (rows, columns), mode="bilinear", antialias=True
                )[0]
            own = images[int(views.frames[place]), k, :, top : top + rows, left : left + columns]
            own.copy_((255 * color).round().clamp(0, 255))
    images[:first] = images[first]
    return images
