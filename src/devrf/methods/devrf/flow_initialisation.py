"""Starts a frame from the frame before it, moved to where its tracks lead.

Steps 2 and 3 of docs/method.md#flow-initialisation; step 1 is ``flow_tracks``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from devrf.engine.graphs import CudaGraphCapture, GraphedStep
from devrf.geometry.cameras import Cameras
from devrf.geometry.space import WORLD, Space
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.flow_tracks import Tracks
from devrf.ops.trilinear import interpolate


def start_from_tracks(
    field: DeformationField,
    frame: int,
    tracks: Tracks,
    cameras: Cameras,
    space: Space = WORLD,
    smoothness: float = 0.01,
    steps: int = 60,
    capturer: CudaGraphCapture | None = None,
) -> None:
    """Fit a frame's two slices, copied from the frame before, to the tracks.

    First Δ_f, so that the tracked points project onto their pixels, then Δ_b, so that it leads
    from there back to them; both by the smoothest change that does. Errors are in pixels and
    robust (Huber), since observed flow has outliers.

    Args:
        field: the deformation field.
        frame: the frame to start, from 1 on.
        tracks: where canonical points are seen at that frame.
        cameras: all cameras.
        space: the space that the field lives in.
        smoothness: weight of differences between neighbouring voxels' changes.
        steps: optimiser steps of each fit.
        capturer: captures a step of each fit in a CUDA graph; None: steps are done one by one.
    """
    if field.still_outside:
        tracks = tracks[field.box.contains(tracks.canonical)]
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

    forward += _fit(misses, forward, scale, smoothness, steps, capturer)
    arrived = tracks.canonical + interpolate(forward, coords)
    there = field.box.to_grid(arrived, field.shape)

    def errs(change: Tensor) -> Tensor:
        returned = arrived + interpolate(backward + change, there)
        return (returned - tracks.canonical) * scale

    backward += _fit(errs, backward, scale, smoothness, steps, capturer)
    field.frames.write(frame, (backward, forward))


def _pixels_per_unit(tracks: Tracks, cameras: Cameras, space: Space, small: float) -> float:
    """By how many pixels the tracked points move in their images for a unit of ``space``."""
    first, _ = cameras.project(tracks.camera, space.to_world(tracks.canonical))
    moves = []
    for axis in torch.eye(3).to(first):
        there = space.to_world(tracks.canonical + small * axis)
        moved, _ = cameras.project(tracks.camera, there)
        moves.append((moved - first).norm(dim=1).mean() / small)
    return float(torch.stack(moves).amax())


@torch.enable_grad()
def _fit(
    residual: Callable[[Tensor], Tensor],
    like: Tensor,
    scale: float,
    smoothness: float,
    steps: int,
    capturer: CudaGraphCapture | None,
) -> Tensor:
    """The smooth change of a grid (X, Y, Z, 3) that makes ``residual(change)`` small.

    Args:
        residual: change → residuals (N, 2 or 3) in pixels.
        like: a grid of the shape and device wanted.
        scale: pixels per unit of the grid's values.
        smoothness: weight of the squared differences between neighbours, in pixels.
        steps: Adam steps; the rate falls linearly from half a pixel a step.
        capturer: as for :func:`start_from_tracks`.
    """
    change, fastest = torch.zeros_like(like).requires_grad_(), 0.5 / scale
    # A graph reads the rate on the device.
    rate = fastest if capturer is None else torch.full((), fastest, device=like.device)
    on_gpu = change.is_cuda
    optimizer = torch.optim.Adam([change], lr=rate, fused=on_gpu, capturable=on_gpu)

    def step() -> None:
        optimizer.zero_grad(set_to_none=capturer is None)
        missed = residual(change)
        error = torch.nn.functional.huber_loss(missed, torch.zeros_like(missed), delta=1.0)
        rough = sum(change.diff(dim=axis).square().sum() for axis in range(3)) * scale**2
        total: Tensor = error + smoothness * rough / like.shape[:3].numel()
        total.backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    graphed = GraphedStep(step, capturer)
    for number in range(steps):
        now = fastest * (1 - number / steps)
        if isinstance(rate, Tensor):
            rate.fill_(now)
        else:
            optimizer.param_groups[0]["lr"] = now
        graphed()
    return change.detach()
