"""The change of colours along the observed motion, without training."""

from __future__ import annotations

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from devrf.data.flow import previous_images
from devrf.scenes.scene import Views

# Number of images whose colours are followed, evenly spread.
IMAGES = 64
# Number of frames over which they are followed back.
STEPS = 4
# With this drift or more, colours are not the canonical ones (docs/method.md#color-drift).
CHANGING = 0.07
# Colours are smoothed before they are compared: detail finer than pixels flickers as it moves.
SIGMA = 1.5
TAPS = 9
# Pixels nearer than this to the alpha mask's edge, or to an occlusion, are left out.
MARGIN = 4


@torch.no_grad()
def color_change(views: Views) -> float | None:
    """Mean |C(u) − C'(u + flow)| in [0, 1] over pixels u whose flow can be followed.

    C' is the image of the same view ``STEPS`` frames earlier (fewer, where the recording is
    shorter), and the flow is followed back through the images between; both are smoothed. Without
    alpha masks only pixels that move by more than half a pixel count, not the backdrop.

    Args:
        views: the dynamic training views.

    Returns:
        The mean over images, channels and pixels; None where no flow can be followed.
    """
    change, _ = _mean_change(views, STEPS)
    return change


def color_drift(views: Views) -> float | None:
    """Change of colours over the whole recording, extrapolated from a few frames.

    See docs/method.md#color-drift: noise and blur change colours as much over two times ``STEPS``
    frames as over ``STEPS``, so the difference of the two is change of the scene.

    Args:
        views: the dynamic training views.

    Returns:
        The change, of which 1 is from black to white; None where no flow can be followed, or where
        the recording has no more than ``STEPS`` steps.
    """
    near, near_steps = _mean_change(views, STEPS)
    far, far_steps = _mean_change(views, 2 * STEPS)
    if near is None or far is None or far_steps == near_steps:
        return None
    all_steps = len(set(views.times.tolist())) - 1
    return (far - near) / (far_steps - near_steps) * all_steps


def _mean_change(views: Views, steps: int) -> tuple[float | None, int]:
    """The mean change over ``steps`` frames, or over as many as there are, and their number."""
    if views.flow is None:
        return None, 0
    previous = previous_images(views).tolist()
    chains = [_chain(image, previous, steps) for image in range(len(views))]
    longest = max(len(chain) for chain in chains)
    followed = [chain for chain in chains if len(chain) == longest > 1]
    spread = followed[:: -(-len(followed) // IMAGES) or 1]
    changes = [change for chain in spread if (change := _change(views, chain)) is not None]
    return sum(changes) / len(changes) if changes else None, longest - 1


def _chain(image: int, previous: list[int], steps: int) -> list[int]:
    """An image and those before it in its view, ``steps`` at most."""
    chain = [image]
    while len(chain) <= steps and previous[chain[-1]] != chain[-1]:
        chain.append(previous[chain[-1]])
    return chain


def _change(views: Views, chain: list[int]) -> float | None:
    """The mean change from a chain's last image to its first; None where too little is left."""
    assert views.flow is not None
    height = views.height
    width = views.width
    x = torch.arange(width) + 0.5
    y = torch.arange(height) + 0.5
    start = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    position = start
    usable = _inside(views, chain[0])
    for image, earlier in zip(chain, chain[1:], strict=False):
        valid = views.flow.valid[image]
        vectors = torch.where(valid[..., None], views.flow.vectors[image], 0.0)
        usable = usable & (_bilinear(valid[None].float(), position)[0] > 0.999)
        position = position + _bilinear(vectors.permute(2, 0, 1), position).permute(1, 2, 0)
        usable = usable & (_bilinear(_inside(views, earlier)[None].float(), position)[0] > 0.999)
    if not views.has_alpha:
        usable = usable & ((position - start).norm(dim=-1) > 0.5)
    if int(usable.sum()) < MARGIN**2:
        return None
    now = _smooth(views, chain[0])
    before = _smooth(views, chain[-1])
    return float((_bilinear(before, position) - now).abs()[:, usable].mean())


def _inside(views: Views, image: int) -> Tensor:
    """(H, W) bool: pixels that are valid and well within the alpha mask, where there is one."""
    outside = torch.zeros(views.height, views.width, dtype=torch.bool)
    if views.has_alpha:
        outside |= views.pixels[image, ..., 3] < 253
    if views.valid_mask is not None:
        outside |= ~views.valid_mask[image]
    grown = max_pool2d(outside[None, None].float(), 2 * MARGIN + 1, stride=1, padding=MARGIN)
    return grown[0, 0] < 0.5


def _smooth(views: Views, image: int) -> Tensor:
    """(3, H, W) the colours of an image in [0, 1], smoothed within the alpha mask."""
    color = views.pixels[image, ..., :3].permute(2, 0, 1).float() / 255
    weight = torch.ones_like(color[:1])
    if views.has_alpha:
        weight = views.pixels[image, ..., 3][None].float() / 255
    return _gaussian(color * weight) / _gaussian(weight).clamp(min=1e-3)


def _gaussian(image: Tensor) -> Tensor:
    """(C, H, W) smoothed, the border repeated."""
    return gaussian_blur2d(image[None], TAPS, (SIGMA, SIGMA), "replicate")[0]


def _bilinear(image: Tensor, position: Tensor) -> Tensor:
    """An image (C, H, W) at ``position`` (H', W', 2), pixels x then y: bilinear, (C, H', W')."""
    _, height, width = image.shape
    scaled = 2 * position / torch.tensor([width, height]) - 1
    return grid_sample(image[None], scaled[None], padding_mode="border", align_corners=False)[0]
