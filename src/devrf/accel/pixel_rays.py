"""Rays and truth of pixels, and the steps of rays through a box: a thread for each ray."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from devrf.accel.blocks import BLOCK, blocks, launch, load_vectors, store_vectors

Triple = tuple[float, float, float]


def gather_pixels(
    image: Tensor,
    flat: Tensor,
    pixels: Tensor,
    poses: Tensor,
    focal: Tensor,
    center: Tensor,
    background: Tensor,
    times: Tensor,
    frames: Tensor,
    flow: tuple[Tensor, Tensor] | None,
) -> tuple[Any, ...]:
    """The fields of devrf.ops.pixel_rays.GatheredPixels."""
    rays, (_, height, width, channels) = len(image), pixels.shape
    origins, directions, color = (poses.new_empty(rays, 3) for _ in range(3))
    alpha, time, pixel = poses.new_empty(rays), poses.new_empty(rays), poses.new_empty(rays, 2)
    frame = torch.empty_like(image)
    # Any pointers stand in for what is not there.
    vector, valid, vectors, known = pixel, pixels, pixel, pixels
    if flow is not None:
        vectors, known = flow[0], flow[1].view(torch.uint8)
        vector, valid = torch.empty_like(pixel), known.new_empty(rays)
    launch(
        gather_kernel,
        blocks(rays),
        *(image.contiguous(), flat.contiguous(), pixels),
        *(poses.contiguous(), focal.contiguous(), center.contiguous(), background.contiguous()),
        *(times.contiguous(), frames.contiguous(), vectors, known),
        *(origins, directions, color, alpha, time, frame, pixel, vector, valid),
        *(rays, width, height * width, 0 if background.dim() == 1 else 3),
        CHANNELS=channels,
        FLOW=flow is not None,
    )
    return (
        *(origins, directions, color, alpha if channels == 4 else None, time, frame, pixel),
        *((None, None) if flow is None else (vector, valid.view(torch.bool))),
    )


def steps_in_box(
    origins: Tensor, directions: Tensor, corners: tuple[Triple, Triple], limits: Triple
) -> tuple[Tensor, Tensor]:
    """As devrf.ops.pixel_rays.steps_in_box; ``limits``: step, near, far."""
    rays = len(origins)
    entry = origins.new_empty(rays)
    count = torch.empty(rays, dtype=torch.int64, device=origins.device)
    launch(
        steps_kernel,
        blocks(rays),
        *(origins.contiguous(), directions.contiguous(), entry, count, rays),
        *(*corners[0], *corners[1], *map(float, limits)),
    )
    return entry, count


@triton.jit
def on_background(rgb, behind, alpha):
    """Composites a channel."""
    return behind + alpha * (rgb - behind)


@triton.jit
def turned(pose, u, v, mask):
    """A row of a pose times (u, −v, −1), and its last entry."""
    direction = tl.load(pose, mask=mask, other=0.0) * u
    direction -= tl.load(pose + 1, mask=mask, other=0.0) * v
    direction -= tl.load(pose + 2, mask=mask, other=0.0)
    return direction, tl.load(pose + 3, mask=mask, other=0.0)


@triton.jit(do_not_specialize=["count", "width", "area", "apart"])
def gather_kernel(
    image,
    flat,
    pixels,
    poses,
    focal,
    center,
    background,
    times,
    frames,
    vectors,
    known,
    origins,
    directions,
    color,
    alpha,
    time,
    frame,
    pixel,
    vector,
    valid,
    count,
    width,
    area,
    apart,
    CHANNELS: tl.constexpr,
    FLOW: tl.constexpr,
):
    """Looks a pixel up; its ray. ``apart`` is 3 where each ray has a background, else 0."""
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = ray < count
    shown = tl.load(image + ray, mask=mask, other=0)
    number = tl.load(flat + ray, mask=mask, other=0)
    row = shown * area + number
    x = (number % width).to(tl.float32) + 0.5
    y = (number // width).to(tl.float32) + 0.5
    tl.store(pixel + ray * 2, x, mask=mask)
    tl.store(pixel + ray * 2 + 1, y, mask=mask)
    tl.store(time + ray, tl.load(times + shown, mask=mask, other=0.0), mask=mask)
    tl.store(frame + ray, tl.load(frames + shown, mask=mask, other=0), mask=mask)
    red = tl.load(pixels + row * CHANNELS, mask=mask, other=0).to(tl.float32) / 255.0
    green = tl.load(pixels + row * CHANNELS + 1, mask=mask, other=0).to(tl.float32) / 255.0
    blue = tl.load(pixels + row * CHANNELS + 2, mask=mask, other=0).to(tl.float32) / 255.0
    if CHANNELS == 4:
        alpha_mask = tl.load(pixels + row * CHANNELS + 3, mask=mask, other=0).to(tl.float32) / 255.0
        tl.store(alpha + ray, alpha_mask, mask=mask)
        behind_red, behind_green, behind_blue = load_vectors(background, ray * apart, mask)
        red = on_background(red, behind_red, alpha_mask)
        green = on_background(green, behind_green, alpha_mask)
        blue = on_background(blue, behind_blue, alpha_mask)
    store_vectors(color, ray * 3, red, green, blue, mask)
    middle_x = tl.load(center + shown * 2, mask=mask, other=0.0)
    middle_y = tl.load(center + shown * 2 + 1, mask=mask, other=0.0)
    u = (x - middle_x) / tl.load(focal + shown * 2, mask=mask, other=1.0)
    v = (y - middle_y) / tl.load(focal + shown * 2 + 1, mask=mask, other=1.0)
    dx, ox = turned(poses + shown * 12, u, v, mask)
    dy, oy = turned(poses + shown * 12 + 4, u, v, mask)
    dz, oz = turned(poses + shown * 12 + 8, u, v, mask)
    length = tl.maximum(tl.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
    store_vectors(origins, ray * 3, ox, oy, oz, mask)
    store_vectors(directions, ray * 3, dx / length, dy / length, dz / length, mask)
    if FLOW:
        trusted = tl.load(known + row, mask=mask, other=0)
        tl.store(valid + ray, trusted, mask=mask)
        used = mask & (trusted != 0)
        along = tl.load(vectors + row * 2, mask=used, other=0.0)
        down = tl.load(vectors + row * 2 + 1, mask=used, other=0.0)
        tl.store(vector + ray * 2, along, mask=mask)
        tl.store(vector + ray * 2 + 1, down, mask=mask)


@triton.jit
def slab(origin, direction, low, high):
    """Distances at which a ray crosses the two faces of a box along an axis, the nearer first."""
    direction = tl.where(tl.abs(direction) < 1e-9, 1e-9, direction)
    to_low = (low - origin) / direction
    to_high = (high - origin) / direction
    return tl.minimum(to_low, to_high), tl.maximum(to_low, to_high)


@triton.jit(do_not_specialize=["rays"])
def steps_kernel(
    origins,
    directions,
    entries,
    counts,
    rays,
    low_x,
    low_y,
    low_z,
    high_x,
    high_y,
    high_z,
    step,
    near,
    far,
):
    """Where a ray enters the box, and how many steps it takes to its exit."""
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = ray < rays
    ox, oy, oz = load_vectors(origins, ray * 3, mask)
    dx, dy, dz = load_vectors(directions, ray * 3, mask)
    from_x, to_x = slab(ox, dx, low_x, high_x)
    from_y, to_y = slab(oy, dy, low_y, high_y)
    from_z, to_z = slab(oz, dz, low_z, high_z)
    entry = tl.maximum(tl.maximum(tl.maximum(from_x, from_y), from_z), near)
    leave = tl.minimum(tl.minimum(tl.minimum(to_x, to_y), to_z), far)
    steps = tl.where(leave >= entry, tl.floor((leave - entry) / step + 1e-3) + 1.0, 0.0)
    tl.store(entries + ray, entry, mask=mask)
    tl.store(counts + ray, steps.to(tl.int64), mask=mask)
