"""Where a frame starts from: the frame before it, moved along the observed optical flow.

A part that moves further in one frame than it is thick does not overlap its old place: no ray
that meets it now passes where it was, and no gradient of the rendering, nor of the flow loss
(which weighs samples by what is rendered), can find it again. The flow itself says where it
went. Each pixel of the frame whose flow leads onto the frame before sees the canonical point
that was rendered there; several views of such pixels say where those points are now. The two
coarse motion grids are fitted to that, in well under a second and without rendering anything.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.data.batch import gather_batch
from devrf.data.pool import PixelPool
from devrf.geometry.cameras import Cameras
from devrf.geometry.space import WORLD, Space
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.volume_rendering import render
from devrf.ops.trilinear import interpolate
from devrf.scenes.scene import Views


@dataclass(frozen=True)
class Tracks:
    """N canonical points that were seen one frame earlier and are seen again.

    Attributes:
        canonical: (N, 3) the points in canonical space.
        camera: (N,) int64, the camera that sees each point now.
        pixel: (N, 2) x, y where it sees it, in pixels.
    """

    canonical: Tensor
    camera: Tensor
    pixel: Tensor

    def __len__(self) -> int:
        return self.canonical.shape[0]


@torch.no_grad()
def follow(
    model: DeVRFModel,
    views: Views,
    pool: PixelPool,
    previous: Tensor,
    time_before: float,
    generator: torch.Generator,
    most: int = 4096,
) -> Tracks:
    """Tracks from the frame before to the present one.

    Args:
        model: the scene, with the frame before learned.
        views: the dynamic training views; their flow must be known.
        pool: pixels of the present frame's images.
        previous: (N,) for each image the one its flow leads to.
        time_before: the time of the frame before.
        generator: of the random choice, on the pool's device.
        most: tracks at most; more pixels are thinned out at random.
    """
    assert views.flow is not None
    area = views.height * views.width
    valid = views.flow.valid.flatten()[pool.image.long() * area + pool.flat.long()]
    kept = valid.nonzero()[:, 0]
    kept = kept[torch.randperm(len(kept), device=kept.device, generator=generator)[:most]]
    image, flat = pool.image[kept].long(), pool.flat[kept].long()
    now = gather_batch(views, image, flat, torch.ones(3, device=image.device))
    assert now.flow is not None
    rays = model.space.rays(views.cameras.rays(previous[image], now.pixel + now.flow))
    seen = render(
        rays,
        model.canonical,
        model.occupancy_at(time_before),
        model.settings,
        torch.ones(3, device=image.device),
        model.warp(time_before),
    )
    point = torch.zeros_like(rays.origins)
    point.index_add_(0, seen.samples.ray, seen.weight[:, None] * seen.canonical)
    mass = torch.zeros(len(rays), device=image.device)
    mass.index_add_(0, seen.samples.ray, seen.weight)
    met = (mass > 0.5).nonzero()[:, 0]
    return Tracks(point[met] / mass[met, None], image[met], now.pixel[met])


def start_from_tracks(
    field: DeformationField,
    frame: int,
    tracks: Tracks,
    cameras: Cameras,
    space: Space = WORLD,
    smoothness: float = 0.01,
    steps: int = 60,
) -> None:
    """Move a frame's two slices, carried from the frame before, along the tracks.

    First the forward slice is changed so that the tracked points fall on their pixels, then
    the backward slice so that it leads back from there; both by the smoothest change that
    does. Errors are counted in pixels, robustly (Huber), since flow is wrong at times.

    Args:
        field: the deformation field.
        frame: the frame to start.
        tracks: where canonical points are seen at that frame.
        cameras: the cameras that the tracks name.
        space: the space that the field lives in.
        smoothness: weight of differences between neighbouring voxels' changes.
        steps: optimiser steps of each fit.
    """
    if len(tracks) == 0:
        return
    scale = _pixels_per_unit(tracks, cameras, space, 1e-3 * field.box.longest)
    backward, forward = (field.frames.here.new_empty(*field.shape, 3) for _ in range(2))
    field.frames.read(frame, (backward, forward))
    coords = field.box.to_grid(tracks.canonical, field.shape)

    def misses(change: Tensor) -> Tensor:
        points = tracks.canonical + interpolate(forward + change, coords)
        pixel, _ = cameras.project(tracks.camera, space.to_world(points))
        return pixel - tracks.pixel

    forward += _fit(misses, forward, scale, smoothness, steps)
    arrived = tracks.canonical + interpolate(forward, coords)
    there = field.box.to_grid(arrived, field.shape)

    def errs(change: Tensor) -> Tensor:
        returned = arrived + interpolate(backward + change, there)
        return (returned - tracks.canonical) * scale

    backward += _fit(errs, backward, scale, smoothness, steps)
    field.frames.write(frame, (backward, forward))


def _pixels_per_unit(tracks: Tracks, cameras: Cameras, space: Space, small: float) -> float:
    """By how many pixels the tracked points move in their images for a unit of the space."""
    first, _ = cameras.project(tracks.camera, space.to_world(tracks.canonical))
    moves = []
    for axis in torch.eye(3).to(first):
        there = space.to_world(tracks.canonical + small * axis)
        moved, _ = cameras.project(tracks.camera, there)
        moves.append((moved - first).norm(dim=1).mean() / small)
    return float(torch.stack(moves).amax())


@torch.enable_grad()
def _fit(
    residual: Callable[[Tensor], Tensor], like: Tensor, scale: float, smoothness: float, steps: int
) -> Tensor:
    """The change of a grid (X, Y, Z, 3) that makes ``residual(change)`` small and is smooth.

    Args:
        residual: change → residuals (N, 2 or 3) in pixels.
        like: a grid of the shape and device wanted.
        scale: pixels per world unit.
        smoothness: weight of the differences between neighbours, in pixels.
        steps: Adam steps; the rate falls linearly from half a pixel a step.
    """
    change = torch.zeros_like(like).requires_grad_()
    optimizer = torch.optim.Adam([change], lr=0.5 / scale)
    decay = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda n: 1 - n / steps)
    for _ in range(steps):
        optimizer.zero_grad()
        missed = residual(change)
        error = torch.nn.functional.huber_loss(missed, torch.zeros_like(missed), delta=1.0)
        rough = sum(change.diff(dim=axis).square().sum() for axis in range(3)) * scale**2
        total: Tensor = error + smoothness * rough / like.shape[:3].numel()
        total.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        decay.step()
    return change.detach()
