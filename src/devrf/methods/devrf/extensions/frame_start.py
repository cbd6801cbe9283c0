"""A visit to a frame starts from the best of several candidates (docs/method.md#frame-start)."""

from __future__ import annotations

import logging

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, pad

from devrf.data.batch import all_pixels
from devrf.engine.ddp import broadcast
from devrf.errors import expect
from devrf.geometry.box import Box
from devrf.kernels.trilinear import interpolate
from devrf.methods.batch import gather_batch
from devrf.methods.devrf.deformation_schedule import DeformationPhase
from devrf.methods.devrf.extension import DeformationContext, Extension
from devrf.methods.devrf.frame_store import Directions
from devrf.methods.devrf.pixel_pools import images_of
from devrf.methods.devrf.volume_rendering import possible_occupancy, render
from devrf.ops.photometric import color_error

log = logging.getLogger(__name__)

# Rounds of the search for a point's position one frame before.
ROUNDS = 2


class StartFromBest(Extension):
    """Starts each visit from the candidate that shows the frame's images best.

    The candidates are the frame's displacements, and those of the frame visited before it: as they
    are, carried on along their velocity, and along their velocity smoothed. The frame has a copy of
    the one before at the coarsest level.
    """

    def __init__(self, levels: int = 0, rays: int = 4096) -> None:
        """Choose the levels at which candidates are compared.

        Args:
            levels: so many of the coarsest levels; 0: none.
            rays: pixels of all the frame's images that candidates are compared by.
        """
        key = "schedule.extensions.frame_start"
        expect(levels >= 0, f"{key}.levels", "at least 0", levels)
        expect(rays >= 1, f"{key}.rays", "at least 1", rays)
        self._levels = levels
        self._rays = rays

    def initialise(self, context: DeformationContext, phase: DeformationPhase) -> None:
        """Give the frame the displacements of the best candidate."""
        if phase.level >= self._levels:
            return
        starts = candidates(context, phase)
        if len(starts) < 2:
            return
        errors = self._errors(context, phase.frame, list(starts.values()))
        best = min(zip(errors, starts, strict=True))[1]
        log.debug(
            "%s frame %d: %s", phase.kind, phase.frame, dict(zip(starts, errors, strict=True))
        )
        field = context.field
        field.frames.write(phase.frame, starts[best])
        # Each process has looked at pixels of its own.
        broadcast([field.backward_slices[phase.frame], field.forward_slices[phase.frame]])

    @torch.no_grad()
    def _errors(
        self, context: DeformationContext, frame: int, starts: list[Directions]
    ) -> list[float]:
        """Mean squared colour error of each start, on the same pixels of all the frame's images."""
        views = context.views
        model = context.model
        pool = all_pixels(views, images_of(views, frame))
        per_pixel = model.settings.rays_per_pixel
        rays = round(context.batch_size.share * self._rays)
        image, flat = pool.draw(max(1, rays // per_pixel), context.generator)
        background = context.background(image, context.generator)
        batch = gather_batch(views, image, flat, background, model.space, per_pixel)
        errors = []
        for backward, _ in starts:
            warp = context.field.warp_by(backward)
            output = render(
                batch.rays,
                model.canonical,
                possible_occupancy(model.occupancy, warp),
                model.settings,
                batch.background,
                backward_warp=warp,
            )
            errors.append(float(color_error(output.color, batch.color, batch.per_pixel)))
        return errors


@torch.no_grad()
def candidates(context: DeformationContext, phase: DeformationPhase) -> dict[str, Directions]:
    """Displacements that a visit may start from, by name; the frame's own are the first."""
    field = context.field
    like = field.frames.here.new_empty(*field.shape, 3)

    def read(number: int) -> Directions:
        pair = (torch.empty_like(like), torch.empty_like(like))
        field.frames.read(number, pair)
        return pair

    starts = {"own": read(phase.frame)}
    near = phase.frame - phase.step
    far = near - phase.step
    frames = range(len(field.clock))
    if near not in frames:
        return starts
    previous = read(near)
    if phase.level:
        starts["as before"] = previous
    if far in frames:
        velocity = previous[1] - read(far)[1]
        starts["carried along"] = carried(previous, velocity, field.box)
        starts["carried along, smoothed"] = carried(previous, smoothed(velocity), field.box)
    return starts


def carried(start: Directions, way: Tensor, box: Box) -> Directions:
    """Displacements a frame later than ``start``, if all goes on along ``way``.

    Δ_f' = Δ_f + v, and Δ_b'(x) = Δ_b(x') − v(q), where x' = x − v(q) is the position before of the
    point at x, and q = x' + Δ_b(x') its canonical point: displacements move with things.

    Args:
        start: (X, Y, Z, 3) Δ_b and Δ_f.
        way: (X, Y, Z, 3) v, the step of each canonical point.
        box: of the grids.
    """
    backward, forward = start
    shape = backward.shape
    points = box.grid_points((shape[0], shape[1], shape[2]), backward).view(-1, 3)
    was = points
    for _ in range(ROUNDS):
        canonical = was + interpolate(backward, was, box)
        step = interpolate(way, canonical, box)
        was = points - step
    return (interpolate(backward, was, box) - step).view(shape), forward + way


def smoothed(grid: Tensor) -> Tensor:
    """Means of a grid (X, Y, Z, C) over the 3³ points around each; beyond its border it goes on."""
    channels_first = grid.permute(3, 0, 1, 2)[None]
    means = avg_pool3d(pad(channels_first, (1,) * 6, mode="replicate"), 3, stride=1)
    return means[0].permute(1, 2, 3, 0).contiguous()
