"""Frames that start where the observed optical flow leads (docs/method.md#flow-initialisation)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from devrf.data.batch import PixelPool, all_pixels
from devrf.data.flow import previous_images
from devrf.engine.ddp import broadcast
from devrf.errors import expect
from devrf.geometry.cameras import Cameras
from devrf.geometry.space import WORLD, Space
from devrf.kernels.trilinear import interpolate
from devrf.methods.batch import gather_batch
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.deformation_schedule import DeformationPhase
from devrf.methods.devrf.extension import DeformationContext, Extension
from devrf.methods.devrf.extensions.smooth_change import led_back, robust, smooth_change
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.pixel_pools import images_of
from devrf.methods.devrf.volume_rendering import render
from devrf.ops.compositing import sum_by_ray
from devrf.rendering.occupancy import Occupancy
from devrf.scenes.scene import Views

# A channel of a pixel differs by at most this from the model's render of the same point.
LIKENESS = 0.15
# Frames that a pixel is followed back at most; drift adds up, and memory holds so many occupancies.
FARTHEST = 16
# Tracks of a frame at most, chosen at random, and optimiser steps of a fit to them.
MOST_TRACKS = 4096
FIT_STEPS = 40
# Weight of differences between neighbouring voxels' changes in a fit.
SMOOTHNESS = 0.01


class StartAlongFlow(Extension):
    """Starts each frame of the coarsest level from the one before it, moved along the flow.

    Frames start from the ones before if there is no flow, or only that of a moving camera.
    """

    def __init__(self, init_from: Literal["previous", "flow", "tracks"] = "tracks") -> None:
        """Choose how far pixels are followed.

        Args:
            init_from: ``flow`` one frame back; ``tracks`` back to a frame in which the model shows
                the pixel's colour; ``previous`` not at all.
        """
        holds = init_from in ("previous", "flow", "tracks")
        key = "schedule.extensions.tracks.init_from"
        expect(holds, key, "previous, flow or tracks", init_from)
        self._init_from = init_from
        self._tracks: FlowTracks | None = None

    def begin_level(self, context: DeformationContext, level: int) -> None:
        """Forget the tracks of the level before."""
        self._tracks = None

    def changes(self, context: DeformationContext, phase: DeformationPhase) -> bool:
        """Whether a phase starts along the flow: at the coarsest level, where there is one."""
        views = context.views
        # All that a moving camera sees flows.
        has_flow = views.flow is not None and not views.by_moving_camera
        return self._init_from != "previous" and has_flow and phase.level == 0

    def initialise(self, context: DeformationContext, phase: DeformationPhase) -> None:
        """Fit the frame's displacements to the points to which its pixels are followed back."""
        if not self.changes(context, phase):
            return
        views = context.views
        model = context.model
        frame = phase.frame
        if self._tracks is None:
            by_color = self._init_from == "tracks"
            self._tracks = FlowTracks(model, views, previous_images(views), by_color=by_color)
        pool = all_pixels(views, images_of(views, frame))
        # Scaled with the batch share.
        most = max(1, round(context.batch_size.share * MOST_TRACKS))
        steps = max(1, round(context.batch_size.share * FIT_STEPS))
        tracks = self._tracks.follow(frame, pool, context.generator, most=most)
        start_from_tracks(context.field, frame, tracks, views.cameras, model.space, steps)
        # Each process has followed pixels of its own.
        broadcast([context.field.backward_slices[frame], context.field.forward_slices[frame]])


@dataclass(frozen=True)
class Tracks:
    """N canonical points that were seen in an earlier frame, and their pixels now.

    Attributes:
        canonical: (N, 3) the points q.
        camera: (N,) int64, the camera that sees each point now.
        pixel: (N, 2) x, y of the point in its image, in pixels.
    """

    canonical: Tensor
    camera: Tensor
    pixel: Tensor

    def __len__(self) -> int:
        return self.canonical.shape[0]

    def __getitem__(self, mask: Tensor) -> Tracks:
        """The tracks where ``mask`` (N,) is True."""
        return Tracks(self.canonical[mask], self.camera[mask], self.pixel[mask])


class FlowTracks:
    """Follows pixels of a frame back to where the model, learned up to there, shows them."""

    def __init__(
        self, model: DeVRFModel, views: Views, previous: Tensor, *, by_color: bool
    ) -> None:
        """Follow pixels of the given views.

        Args:
            model: the scene; frames before the one that is asked for have been learned.
            views: the dynamic training views; their flow must be known.
            previous: (N,) int64, for each image the one that its flow leads to.
            by_color: whether the point that is met must have the pixel's colour; else each pixel
                ends one frame back, whatever it meets there.
        """
        self.model = model
        self.views = views
        self.previous = previous
        self.likeness = LIKENESS if by_color else math.inf
        self.farthest = FARTHEST if by_color else 1
        self._occupancies: dict[int, Occupancy] = {}

    @torch.no_grad()
    def follow(
        self,
        frame: int,
        pool: PixelPool,
        generator: torch.Generator,
        *,
        most: int = MOST_TRACKS,
    ) -> Tracks:
        """Tracks Σ w_i q_i / Σ w_i to a frame.

        Args:
            frame: the present frame, from 1 on; those before it have been learned.
            pool: pixels of its images.
            generator: of the random choice, on the pool's device.
            most: pixels at most, chosen at random.
        """
        views = self.views
        assert views.flow is not None
        valid = views.flow.valid.flatten()[pool.image.long() * self._area + pool.flat.long()]
        valid_pixels = valid.nonzero()[:, 0]
        order = torch.randperm(len(valid_pixels), device=valid.device, generator=generator)
        sample = valid_pixels[order[:most]]
        image = pool.image[sample].long()
        flat = pool.flat[sample].long()
        batch = gather_batch(views, image, flat, torch.ones(3, device=image.device))
        # Numbers in the batch, and positions, of the pixels that are still followed.
        number = torch.arange(len(image), device=image.device)
        position = batch.pixel
        ended: list[Tensor] = []
        points: list[Tensor] = []
        for step in range(1, min(frame, self.farthest) + 1):
            followed, position = self._back(image, position)
            number = number[followed]
            image = self.previous[image[followed]]
            point, color, mass = self._look(frame - step, image, position)
            difference = (color - batch.color[number]).abs().amax(dim=1)
            matches = (mass > 0.5) & (difference < self.likeness)
            ended.append(number[matches])
            points.append(point[matches])
            number = number[~matches]
            image = image[~matches]
            position = position[~matches]
            if len(number) == 0:
                break
        index = torch.cat(ended)
        return Tracks(
            canonical=torch.cat(points), camera=batch.image[index], pixel=batch.pixel[index]
        )

    @property
    def _area(self) -> int:
        return self.views.height * self.views.width

    def _back(self, image: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """Whether each of N positions can be followed one frame back, and M positions there (M, 2).

        Args:
            image: (N,) int64, the image of each position.
            position: (N, 2) x, y in pixels; the flow is that of the pixel it lies in.
        """
        flow = self.views.flow
        assert flow is not None
        column, row = position.floor().long().unbind(dim=1)
        going = (column >= 0) & (column < self.views.width)
        going &= (row >= 0) & (row < self.views.height) & (self.previous[image] != image)
        at = torch.where(going, image * self._area + row * self.views.width + column, 0)
        going &= flow.valid.flatten()[at]
        return going, position[going] + flow.vectors.reshape(-1, 2)[at[going]]

    def _look(self, frame: int, image: Tensor, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The model's render at positions (N, 2) of images (N,) of a frame.

        Returns:
            The mean canonical point (N, 3), the colour (N, 3) on white, and Σ w_i (N,).
        """
        model = self.model
        deformation = self.model.deformation
        assert deformation is not None
        time = deformation.clock.times[frame]
        seen = render(
            model.space.rays(self.views.cameras.rays(image, position)),
            model.canonical,
            self._occupancy(frame, time),
            model.settings,
            torch.ones(3, device=image.device),
            model.backward_warp(time),
        )
        count = len(image)
        ray = seen.samples.ray
        weight = seen.samples.weight
        mass = sum_by_ray(weight, ray, count)
        point = sum_by_ray(weight[:, None] * seen.samples.canonical, ray, count)
        return point / mass[:, None], seen.color, mass

    def _occupancy(self, frame: int, time: float) -> Occupancy:
        """The occupancy of a frame, which no longer changes; the newest ones are kept."""
        if frame not in self._occupancies:
            self._occupancies[frame] = self.model.occupancy_at(time)
            self._occupancies.pop(frame - self.farthest, None)
        return self._occupancies[frame]


def start_from_tracks(
    field: DeformationField,
    frame: int,
    tracks: Tracks,
    cameras: Cameras,
    space: Space = WORLD,
    steps: int = FIT_STEPS,
) -> None:
    """Fit a frame's two slices, copied from the frame before, to the tracks.

    Δ_f is fitted first, so that the tracked points project onto their pixels, then Δ_b, so that it
    leads from there back to them; both by the smoothest change that does. Errors are in pixels and
    robust (Huber), since observed flow has outliers. Projections are linearised about the points,
    and halfway through the steps about the points to which the first half has led.

    Args:
        field: the deformation field.
        frame: the frame to start, from 1 on.
        tracks: pixels of canonical points at that frame.
        cameras: all cameras.
        space: the field's space.
        steps: optimiser steps of each fit.
    """
    if field.zero_outside_box:
        tracks = tracks[field.box.contains(tracks.canonical)]
    if len(tracks) == 0:
        return
    backward = field.frames.here.new_empty(*field.shape, 3)
    forward = torch.empty_like(backward)
    field.frames.read(frame, (backward, forward))
    small = 1e-3 * field.box.longest
    points = tracks.canonical

    missed, slopes = _projected(tracks, points, cameras, space, small)
    # Pixels to a unit of length, along the axis that moves pixels most.
    scale = float(slopes.norm(dim=1).mean(dim=0).amax())

    def missed_pixels(change: Tensor, step: int) -> Tensor:
        nonlocal missed, slopes
        way = interpolate(change, points, field.box)
        if step in (0, steps // 2):
            there = points + interpolate(forward + change.detach(), points, field.box)
            missed, slopes = _projected(tracks, there, cameras, space, small)
            missed -= _moved(slopes, way.detach())
        return robust(missed + _moved(slopes, way))

    forward += smooth_change(
        missed_pixels, like=forward, scale=scale, steps=steps, smoothness=SMOOTHNESS
    )
    backward = led_back(
        backward,
        forward,
        points,
        field.box,
        scale=scale,
        steps=steps,
        smoothness=SMOOTHNESS,
    )
    field.frames.write(frame, (backward, forward))


def _projected(
    tracks: Tracks, points: Tensor, cameras: Cameras, space: Space, small: float
) -> tuple[Tensor, Tensor]:
    """Errors (N, 2) in pixels of ``points`` (N, 3) against N tracks, and their slopes (N, 2, 3).

    Slopes are for a unit of ``space`` along each axis, by differences over ``small``.
    """
    seen, _ = cameras.project(tracks.camera, space.to_world(points))
    slopes = []
    for axis in torch.eye(3).to(points):
        there = space.to_world(points + small * axis)
        moved, _ = cameras.project(tracks.camera, there)
        slopes.append((moved - seen) / small)
    return seen - tracks.pixel, torch.stack(slopes, dim=-1)


def _moved(slopes: Tensor, way: Tensor) -> Tensor:
    """Displacements (N, 2) in pixels of points that move by ``way`` (N, 3)."""
    return (slopes * way[:, None]).sum(dim=-1)
