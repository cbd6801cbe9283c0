"""The occupancy of each frame, by alpha masks or the field itself: empty space is skipped."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor

from devrf.checkpoints.stored_grids import StoredShape
from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.nerf.samples import RaySamples, last_of_ray
from devrf.ops.march import numbered, steps_through
from devrf.rendering.occupancy import dilate
from devrf.scenes.scene import Scene
from devrf.scenes.silhouettes import visual_hull

# A cell with less opacity a step than this is empty.
LEAST = 0.01
# A cell keeps this share of its opacity, unless that at a random place and time is larger.
DECAY = 0.9
# After so many iterations this share of the cells is evaluated again.
EVERY = 16
SHARE = 0.5
# The first time all cells are evaluated, at so many times.
FIRST = 4
# Points at which a field is evaluated at once.
CHUNK = 1 << 18


class LearnedOccupancy(StoredShape):
    """A decaying maximum over places and times of each cell's opacity, learned beside the field.

    Attributes:
        opacity: (X, Y, Z) of a step; 1 until it is evaluated. (0, 0, 0): nothing is left out.
    """

    resizable: ClassVar = {"opacity": 3}
    opacity: Tensor

    def __init__(self, shape: tuple[int, int, int] = (0, 0, 0)) -> None:
        """Exclude nothing.

        Args:
            shape: cells over a box, corners on its corners; all 0: nothing is ever left out.
        """
        super().__init__()
        self.register_buffer("opacity", torch.ones(shape))
        self._step: int | None = None  # the iteration that was followed last

    def occupied(self, cell: Tensor) -> Tensor | None:
        """Whether something may be in cells of row-major numbers (S,): (S,) bool; None: in all."""
        if not self.opacity.numel():
            return None
        return self.opacity.view(-1).index_select(0, cell) > LEAST

    @torch.no_grad()
    def follow(
        self,
        step: int,
        total: int,
        share: float | None,
        box: Box,
        opacity_at: Callable[[Tensor, Tensor], Tensor],
    ) -> None:
        """Look at cells again if iteration ``step`` is one to do so.

        Args:
            step: iteration of a stage, from 0; at 0 the results of another stage are forgotten.
            total: iterations of the stage.
            share: share of these before which nothing is left out; None: nothing ever is.
            box: of the cells, in the fields' space.
            opacity_at: the opacity (S,) of a step at points (S, 3) of that space and times (S,) in
                [0, 1].
        """
        # A time budget may leave iterations out, or stay at one.
        if share is None or not self.opacity.numel() or step == self._step:
            return
        if step == 0:
            self.opacity.fill_(1)
        start = round(share * total)
        previous = step if self._step is None else self._step
        self._step = step
        previous = min(previous, step - 1)
        if step < start or step // EVERY == previous // EVERY:
            return
        flat = self.opacity.view(-1)
        # Of its own: processes draw differently from the global one, and have to agree here.
        generator = torch.Generator(flat.device).manual_seed(step)
        if previous // EVERY * EVERY < start:
            flat.zero_()
            looks = [torch.arange(len(flat), device=flat.device)] * FIRST
        else:
            chosen = torch.rand(len(flat), device=flat.device, generator=generator) < SHARE
            looks = [chosen.nonzero()[:, 0]]
        for cells in looks:
            for part in torch.split(cells, CHUNK):
                points = self._points(part, box, generator)
                time = torch.rand(len(part), device=flat.device, generator=generator)
                # A field that has diverged leaves nothing out.
                opacity = opacity_at(points, time).nan_to_num(nan=1.0)
                flat[part] = torch.maximum(DECAY * flat[part], opacity)

    def _points(self, cells: Tensor, box: Box, generator: torch.Generator) -> Tensor:
        """A random point (S, 3) nearest to each of the grid points of numbers (S,)."""
        index = torch.stack(torch.unravel_index(cells, self.opacity.shape), dim=1)
        low, high = box.corners(self.opacity)
        last = torch.tensor(self.opacity.shape, device=cells.device) - 1
        random = torch.rand(len(cells), 3, device=cells.device, generator=generator)
        jittered = index + random - 0.5
        return box.nearest(low + jittered / last * (high - low))


class OccupancyFrames(StoredShape):
    """Masks (T, X, Y, Z) of T frames over a box.

    Attributes:
        mask: (T, X, Y, Z) bool, True where something may be.
        learned: space that the field leaves empty at all times, if alpha masks do not tell.
    """

    resizable: ClassVar = {"mask": 4}
    mask: Tensor

    def __init__(self, frames: int, shape: tuple[int, int, int]) -> None:
        """Exclude nothing."""
        super().__init__()
        self.register_buffer("mask", torch.ones(frames, *shape, dtype=torch.bool))
        self.learned = LearnedOccupancy()

    @property
    def has_hull(self) -> bool:
        """Whether alpha masks leave anything out."""
        return not bool(self.mask.all())

    @classmethod
    @torch.no_grad()
    def of(
        cls, scene: Scene, box: Box, side: int, *, hull: bool, empty_from: float | None = None
    ) -> OccupancyFrames:
        """Masks of each of the scene's frames over ``box``, of about ``side``³ cells.

        Args:
            scene: seen from all around, the training images' alpha masks carve them, grown by a
                cell; static images show frame 0. Space that no camera of another frame sees is as
                at rest. In other scenes the field itself has to tell what is empty.
            box: in the fields' space.
            side: cells along an edge of a cube of the box's size.
            hull: whether to carve at all.
            empty_from: share of a stage after which the field is evaluated; None: never.
        """
        shape = box.grid_shape(side**3)
        masks = cls(len(scene.clock), shape)
        carved = hull and scene.kind == "inward" and scene.space.is_linear
        for views in (scene.static.train, scene.dynamic.train) if carved else ():
            assert views.frames is not None
            for frame in torch.unique(views.frames).tolist() if views.has_alpha else ():
                frame_views = views[(views.frames == frame).nonzero()[:, 0]]
                masks.mask[frame] &= dilate(visual_hull(frame_views, box, shape), 1).cpu()
                if frame > 0:
                    held = visual_hull(frame_views, box, shape, whole_in_view=True)
                    masks.mask[frame] &= dilate(held, 1).cpu() | masks.mask[0]
        if empty_from is not None and not masks.has_hull:
            masks.learned = LearnedOccupancy(shape)
        return masks

    def march(
        self,
        rays: Rays,
        frames: tuple[Tensor, Tensor],
        box: Box,
        depths: tuple[float, float],
        step: float,
        *,
        jitter: bool,
    ) -> RaySamples:
        """Samples every ``step`` along rays, where something may be at one of two frames.

        Args:
            rays: R rays in the fields' space.
            frames: (R,) int64 twice: the frames before and after each ray's time.
            box: of the masks, in the fields' space.
            depths: distances between which rays are sampled.
            step: in units of the rays' directions.
            jitter: move all samples of a ray by a random part of a step.
        """
        near, far = depths
        entry, count = steps_through(rays, box, step=step, near=near, far=far)
        ray, number = numbered(count)
        offset = torch.rand_like(entry) if jitter else torch.full_like(entry, 0.5)
        shifted = number + offset.index_select(0, ray)
        distance = entry.index_select(0, ray) + shifted * step
        pair = (frames[0].index_select(0, ray), frames[1].index_select(0, ray))
        masked, occupied = self._may_be(rays.at(ray, distance), pair, box)
        if occupied is not None:
            # The last sample of a ray stays: it may stand for all that is behind it.
            masked &= occupied | last_of_ray(ray)
        index = masked.nonzero()[:, 0]
        kept = ray.index_select(0, index)
        return RaySamples.at(rays, kept, distance.index_select(0, index), step)

    def may_be_at(self, points: Tensor, frames: tuple[int, int], box: Box) -> Tensor:
        """Whether something may be at ``points`` (S, 3) at one of two frames: (S,) bool."""
        first = torch.zeros_like(points[:, 0], dtype=torch.int64)
        masked, occupied = self._may_be(points, (first + frames[0], first + frames[1]), box)
        return masked if occupied is None else masked & occupied

    def _may_be(
        self, points: Tensor, frames: tuple[Tensor, Tensor], box: Box
    ) -> tuple[Tensor, Tensor | None]:
        """Whether the masks of frames (S,), and the learned ones, leave ``points`` (S, 3) in."""
        _, x, y, z = self.mask.shape
        nearest = box.to_grid(box.nearest(points), (x, y, z)).round().long()
        cell = (nearest[:, 0] * y + nearest[:, 1]) * z + nearest[:, 2]
        masks = self.mask.view(-1)
        cells = self.mask[0].numel()
        before, after = (frame * cells + cell for frame in frames)
        masked = masks.index_select(0, before) | masks.index_select(0, after)
        return masked, self.learned.occupied(cell)
