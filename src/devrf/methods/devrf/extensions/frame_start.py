"""A visit to a frame starts from the best of several candidates (docs/method.md#frame-start)."""

from __future__ import annotations

import logging

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, pad

from devrf.data.batch import RayBatch, all_pixels
from devrf.engine.ddp import broadcast
from devrf.errors import expect
from devrf.geometry.box import Box
from devrf.geometry.space import WorldSpace
from devrf.kernels.trilinear import interpolate
from devrf.methods.batch import gather_batch
from devrf.methods.devrf.deformation_schedule import DeformationPhase
from devrf.methods.devrf.extension import DeformationContext, Extension
from devrf.methods.devrf.extensions.smooth_change import led_back
from devrf.methods.devrf.extensions.splat_alignment import SplatAlignment
from devrf.methods.devrf.frame_store import Directions
from devrf.methods.devrf.pixel_pools import images_of
from devrf.methods.devrf.volume_rendering import possible_occupancy, render
from devrf.ops.photometric import color_error

log = logging.getLogger(__name__)

# Rounds of the search for a point's position one frame before.
ROUNDS = 2
# A start whose error is so many times that of the rest state at most needs no Gaussians.
ENOUGH = 2.0
# Steps in which Δ_b is fitted to Δ_f, and the weight of differences between neighbours' changes.
BACK_STEPS, BACK_SMOOTHNESS = 30, 0.01


class StartFromBest(Extension):
    """Starts each visit from the candidate that shows the frame's images best.

    The candidates are the frame's displacements, and those of the frame visited before it: as they
    are, carried on along their velocity, and along their velocity smoothed. The frame has a copy of
    the one before at the coarsest level; there, without optical flow, the best is compared with
    what Gaussians make of it
    (:class:`~devrf.methods.devrf.extensions.splat_alignment.SplatAlignment`), unless it shows the
    frame about as well as the rest state shows the first one.
    """

    def __init__(
        self, levels: int = 0, with_flow: bool = True, rays: int = 4096, gaussians: int = 0
    ) -> None:
        """Choose the levels at which candidates are compared.

        Args:
            levels: so many of the coarsest levels; 0: none, but for ``gaussians``.
            with_flow: also where optical flow is known.
            rays: pixels of all the frame's images that candidates are compared by.
            gaussians: the most by which the best candidate of the coarsest level is moved on,
                where no optical flow is known; 0: it is not.
        """
        key = "schedule.extensions.frame_start"
        expect(levels >= 0, f"{key}.levels", "at least 0", levels)
        expect(rays >= 1, f"{key}.rays", "at least 1", rays)
        expect(gaussians >= 0, f"{key}.gaussians", "at least 0", gaussians)
        self._levels = levels
        self._with_flow = with_flow
        self._rays = rays
        self._gaussians = gaussians
        self._alignment: SplatAlignment | None = None
        self._rest_error: float | None = None

    def setup(self, context: DeformationContext) -> None:
        """Forget the scene before."""
        self._alignment = None
        self._rest_error = None

    def begin_level(self, context: DeformationContext, level: int) -> None:
        """Free the Gaussians after the coarsest level."""
        if level > 0:
            self._alignment = None

    def initialise(self, context: DeformationContext, phase: DeformationPhase) -> None:
        """Give the frame the displacements of the best candidate."""
        aligns = phase.level == 0 and self._aligns(context, phase.frame)
        compares = aligns or self._compares(context, phase.level)
        starts = candidates(context, phase) if compares else {}
        if len(starts) < 2 and not aligns:
            return
        batch = self._batch(context, phase.frame, context.generator)
        errors = {name: self._error(context, batch, start) for name, start in starts.items()}
        best = min(errors, key=errors.__getitem__)
        if aligns and errors[best] > ENOUGH * self._error_at_rest(context):
            aligned = self._aligned(context, phase.frame, starts[best])
            starts |= aligned
            errors |= {name: self._error(context, batch, aligned[name]) for name in aligned}
            best = min(errors, key=errors.__getitem__)
        log.debug("%s frame %d: %s", phase.kind, phase.frame, errors)
        field = context.field
        field.frames.write(phase.frame, starts[best])
        # Each process has looked at pixels of its own.
        broadcast([field.backward_slices[phase.frame], field.forward_slices[phase.frame]])

    def _compares(self, context: DeformationContext, level: int) -> bool:
        """Whether candidates are compared at a level, even if there are no Gaussians."""
        by_level = level < self._levels
        return by_level and (self._with_flow or context.views.flow is None)

    def _aligns(self, context: DeformationContext, frame: int) -> bool:
        """Whether Gaussians tell how a frame has moved: by several masked views, in world space.

        Optical flow tells it better, and costs less. In a budget of seconds the iterations that it
        costs are worth more.
        """
        if self._gaussians == 0 or context.batch_size.is_timed or context.views.flow is not None:
            return False
        views = context.views
        if not isinstance(context.model.space, WorldSpace) or len(images_of(views, frame)) < 2:
            return False
        return views.cut_out and context.datamodule.scene.static.train.cut_out

    def _aligned(
        self, context: DeformationContext, frame: int, start: Directions
    ) -> dict[str, Directions]:
        """``start``, changed by what Gaussians that move on from it tell; two of different Δ_b."""
        model, views, box = context.model, context.views, context.field.box
        if self._alignment is None:
            at_rest = context.datamodule.scene.static.train
            self._alignment = SplatAlignment(model, at_rest, self._gaussians)
        images = images_of(views, frame).tolist()
        change = self._alignment.change(model, views, images, forward=start[1], box=box)
        backward, forward = carried(start, change, box)
        fitted = led_back(
            backward,
            forward,
            self._alignment.points,
            box,
            scale=1 / views.cameras.pixel_size(torch.tensor(box.middle)),
            steps=BACK_STEPS,
            smoothness=BACK_SMOOTHNESS,
        )
        return {"by Gaussians": (backward, forward), "by Gaussians, led back": (fitted, forward)}

    def _error_at_rest(self, context: DeformationContext) -> float:
        """The error of the rest state in the first frame; 0 where no image shows that."""
        if len(images_of(context.views, 0)) == 0:
            return 0.0
        if self._rest_error is None:
            # Whenever it is asked for, as after a resume, the draws of visits are the same.
            generator = torch.Generator(context.model.device).manual_seed(0)
            batch = self._batch(context, 0, generator)
            still = context.field.frames.here.new_zeros(*context.field.shape, 3)
            self._rest_error = self._error(context, batch, (still, still))
        return self._rest_error

    def _batch(
        self, context: DeformationContext, frame: int, generator: torch.Generator
    ) -> RayBatch:
        """The pixels of all the frame's images that its candidates are compared by."""
        views = context.views
        pool = all_pixels(views, images_of(views, frame))
        per_pixel = context.model.settings.rays_per_pixel
        rays = round(context.batch_size.share * self._rays)
        image, flat = pool.draw(max(1, rays // per_pixel), generator)
        background = context.background(image, generator)
        return gather_batch(views, image, flat, background, context.model.space, per_pixel)

    @torch.no_grad()
    def _error(self, context: DeformationContext, batch: RayBatch, start: Directions) -> float:
        """The mean squared colour error of a start."""
        model = context.model
        warp = context.field.warp_by(start[0])
        output = render(
            batch.rays,
            model.canonical,
            possible_occupancy(model.occupancy, warp),
            model.settings,
            batch.background,
            backward_warp=warp,
        )
        return float(color_error(output.color, batch.color, batch.per_pixel))


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
        times = field.clock.times
        # Rounded, since times are known up to rounding: evenly spaced frames go on by one step.
        ratio = round((times[phase.frame] - times[near]) / (times[near] - times[far]), 4)
        way = ratio * (previous[1] - read(far)[1])
        starts["carried along"] = carried(previous, way, field.box)
        starts["carried along, smoothed"] = carried(previous, smoothed(way), field.box)
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
