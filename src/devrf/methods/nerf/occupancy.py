"""Where something may be at each frame, by alpha masks or the field itself: the rest is skipped."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from devrf.checkpoints.stored_grids import StoredShape
from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.nerf.samples import RaySamples
from devrf.rendering.occupancy import dilate
from devrf.rendering.sampling import steps_through
from devrf.scenes.scene import Scene
from devrf.scenes.silhouettes import visual_hull

# A cell is empty below LEAST of opacity a step: what it is at a random place and time, or DECAY
# of what it was. EVERY so many iterations a SHARE of all cells is looked at anew; the first time
# all of them, at FIRST times.
LEAST, DECAY, EVERY, SHARE, FIRST = 0.01, 0.9, 16, 0.5, 4
# Points that a field is asked for at once.
CHUNK = 1 << 18


class LearnedOccupancy(StoredShape):
    """A decaying maximum over places and times of each cell's opacity, learned beside the field.

    Attributes:
        opacity: (X, Y, Z) of a step; 1 until the field is asked. (0, 0, 0): nothing is left out.
    """

    resizable = ("opacity",)
    opacity: Tensor

    def __init__(self, shape: tuple[int, int, int] = (0, 0, 0)) -> None:
        """Exclude nothing.

        Args:
            shape: cells over a box, corners on its corners; all 0: nothing is ever left out.
        """
        super().__init__()
        self.register_buffer("opacity", torch.ones(shape))

    def occupied(self, cell: Tensor) -> Tensor | None:
        """Whether something may be in cells of row-major numbers (S,): (S,) bool; None: in all."""
        if not self.opacity.numel():
            return None
        return self.opacity.view(-1)[cell] > LEAST

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
            step: of a stage, from 0; what another stage saw is forgotten there.
            total: iterations of the stage.
            share: of these, before which nothing is left out; None: nothing ever is.
            box: where the cells are, in the fields' space.
            opacity_at: the opacity (S,) of a step at points (S, 3) of that space and times (S,) in
                [0, 1].
        """
        if share is None or not self.opacity.numel():
            return
        if step == 0:
            self.opacity.fill_(1)
        start = round(share * total)
        if step < start or step % EVERY:
            return
        count, flat = self.opacity.numel(), self.opacity.view(-1)
        if step < start + EVERY:
            flat.zero_()
            for _ in range(FIRST):
                self._look(torch.arange(count, device=flat.device), box, opacity_at)
        else:
            chosen = torch.rand(count, device=flat.device) < SHARE
            self._look(chosen.nonzero()[:, 0], box, opacity_at)

    def _look(
        self, cells: Tensor, box: Box, opacity_at: Callable[[Tensor, Tensor], Tensor]
    ) -> None:
        flat = self.opacity.view(-1)
        for part in torch.split(cells, CHUNK):
            points = self._points(part, box)
            seen = opacity_at(points, torch.rand_like(points[:, 0]))
            flat[part] = torch.maximum(DECAY * flat[part], seen)

    def _points(self, cells: Tensor, box: Box) -> Tensor:
        """A random point (S, 3) nearest to each of the grid points of numbers (S,)."""
        _, y, z = self.opacity.shape
        place = torch.stack([cells // (y * z), cells // z % y, cells % z], dim=1)
        low, high = box.corners(self.opacity)
        last = torch.tensor(self.opacity.shape, device=cells.device) - 1
        jittered = place + torch.rand(len(cells), 3, device=cells.device) - 0.5
        return box.nearest(low + jittered / last * (high - low))


def diagonal_step(box: Box, rays: Rays, steps: int) -> float:
    """One of ``steps`` even steps along the box's diagonal, in units of the longest direction."""
    unit = float(rays.directions.norm(dim=1).amax()) if len(rays) else 1.0
    return box.diagonal / (steps * unit)


class OccupancyFrames(StoredShape):
    """Masks (T, X, Y, Z) of T frames over a box.

    Attributes:
        mask: (T, X, Y, Z) bool, True where something may be.
        learned: what the field leaves empty at all times, where alpha masks do not tell.
    """

    resizable = ("mask",)
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
    def of(
        cls,
        scene: Scene,
        box: Box,
        side: int,
        device: torch.device,
        *,
        hull: bool,
        empty_from: float | None = None,
    ) -> OccupancyFrames:
        """Masks of each of the scene's frames over ``box``, of about ``side``³ cells.

        Args:
            scene: seen from all around its alpha masks carve them; else the field itself has to
                tell what is empty.
            box: in the fields' space.
            side: cells along an edge of a cube of the box's size.
            device: where the masks are.
            hull: whether to carve at all.
            empty_from: share of a stage after which the field is asked; None: never.
        """
        masks = cls(len(scene.clock), box.grid_shape(side**3)).to(device)
        if hull and scene.kind == "inward" and scene.space.is_linear:
            masks.carve(scene, box)
        if empty_from is not None and not masks.has_hull:
            _, x, y, z = masks.mask.shape
            masks.learned = LearnedOccupancy((x, y, z)).to(device)
        return masks

    @torch.no_grad()
    def carve(self, scene: Scene, box: Box) -> None:
        """Take the visual hull of each frame's alpha masks, grown by a cell; nothing without.

        Args:
            scene: its training views are looked at; static images show frame 0.
            box: where the masks live, in world units.
        """
        _, *points = self.mask.shape
        x, y, z = points
        for views in (scene.static.train, scene.dynamic.train):
            if not views.has_alpha:
                continue
            assert views.frames is not None
            for frame in torch.unique(views.frames).tolist():
                shown = views[(views.frames == frame).nonzero()[:, 0]]
                hull = dilate(visual_hull(shown, box, (x, y, z)), 1)
                self.mask[frame] &= hull.to(self.mask.device)

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
            box: where the masks live, in the fields' space.
            depths: distances between which rays are sampled.
            step: in units of the rays' directions.
            jitter: move all samples of a ray by a random part of a step.
        """
        near, far = depths
        entry, count = steps_through(rays, box, step=step, near=near, far=far)
        ray = torch.repeat_interleave(count)
        number = torch.arange(len(ray), device=ray.device) - (count.cumsum(0) - count)[ray]
        offset = torch.rand_like(entry) if jitter else torch.full_like(entry, 0.5)
        distance = entry[ray] + (number + offset[ray]) * step
        cell = self._cells(rays.at(ray, distance), box)
        flat, cells = self.mask.flatten(1), self.mask[0].numel()
        met = torch.zeros_like(ray, dtype=torch.bool)
        for frame in frames:
            met |= flat.view(-1)[frame[ray] * cells + cell]
        occupied = self.learned.occupied(cell)
        if occupied is not None:
            # The last sample of a ray stays: it may stand for all that is behind it.
            met &= occupied | (number == count[ray] - 1)
        kept = met.nonzero()[:, 0]
        return RaySamples.at(rays, ray[kept], distance[kept], step)

    def _cells(self, points: Tensor, box: Box) -> Tensor:
        """The row-major number (M,) of the grid point nearest to each of ``points`` (M, 3)."""
        _, x, y, z = self.mask.shape
        place = box.to_grid(box.nearest(points), (x, y, z)).round().long()
        return (place[:, 0] * y + place[:, 1]) * z + place[:, 2]
