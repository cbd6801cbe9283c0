"""Follows pixels back along the observed flow, to the canonical points that they see.

Step 1 of docs/method.md#flow-initialisation; steps 2 and 3 are ``flow_initialisation``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.data.batch import PixelPool
from devrf.engine.batches import gather_batch
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.volume_rendering import render
from devrf.ops.compositing import sum_by_ray
from devrf.rendering.occupancy import Occupancy
from devrf.scenes.scene import Views

# By how much a channel of a pixel may differ from what the model shows where it was, to be it.
LIKENESS = 0.15
# Frames that a pixel is followed back at most; drift adds up, and memory holds so many occupancies.
FARTHEST = 16


@dataclass(frozen=True)
class Tracks:
    """N canonical points that were seen in an earlier frame, and where they are seen now.

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
    """Follows pixels of a frame back to where the model, learned up to there, shows them.

    One frame back may show something else: an occluder that has since moved away, or a part that
    the model has lost there. Such a pixel goes on, frame by frame, to one where it was right.
    """

    def __init__(
        self, model: DeVRFModel, views: Views, previous: Tensor, *, by_color: bool
    ) -> None:
        """Follow pixels of the given views.

        Args:
            model: the scene; frames before the one that is asked for have been learned.
            views: the dynamic training views; their flow must be known.
            previous: (N,) int64, for each image the one that its flow leads to.
            by_color: whether what is met must have the pixel's colour; else each pixel ends one
                frame back, whatever it meets there.
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
        learned: int,
        most: int = 4096,
    ) -> Tracks:
        """Tracks Σ w_i q_i / Σ w_i to a frame.

        Args:
            frame: the present frame, from 1 on.
            pool: pixels of its images.
            generator: of the random choice, on the pool's device.
            learned: how many of the frames before it have been learned, or are at rest.
            most: tracks at most, chosen at random.
        """
        views = self.views
        assert views.flow is not None
        valid = views.flow.valid.flatten()[pool.image.long() * self._area + pool.flat.long()]
        kept = valid.nonzero()[:, 0]
        kept = kept[torch.randperm(len(kept), device=kept.device, generator=generator)[:most]]
        here, flat = pool.image[kept].long(), pool.flat[kept].long()
        now = gather_batch(views, here, flat, torch.ones(3, device=here.device))
        place, waiting = now.pixel, torch.arange(len(here), device=here.device)
        found: list[tuple[Tensor, Tensor]] = []
        for step in range(1, min(learned, self.farthest) + 1):
            going, place = self._back(here, place)
            waiting, here = waiting[going], self.previous[here[going]]
            point, color, mass = self._look(frame - step, here, place)
            unlike = (color - now.color[waiting]).abs().amax(dim=1)
            right = (mass > 0.5) & (unlike < self.likeness)
            found.append((waiting[right], point[right]))
            waiting, here, place = waiting[~right], here[~right], place[~right]
            if len(waiting) == 0:
                break
        index, points = (torch.cat(column) for column in zip(*found, strict=True))
        return Tracks(points, now.image[index], now.pixel[index])

    @property
    def _area(self) -> int:
        return self.views.height * self.views.width

    def _back(self, image: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        """Which of N places can be followed one frame back (N,) bool, and where to (M, 2).

        Args:
            image: (N,) int64, the image of each place.
            place: (N, 2) x, y in pixels; the flow is that of the pixel it lies in.
        """
        flow = self.views.flow
        assert flow is not None
        column, row = place.floor().long().unbind(dim=1)
        going = (column >= 0) & (column < self.views.width)
        going &= (row >= 0) & (row < self.views.height) & (self.previous[image] != image)
        at = torch.where(going, image * self._area + row * self.views.width + column, 0)
        going &= flow.valid.flatten()[at]
        return going, place[going] + flow.vectors.reshape(-1, 2)[at[going]]

    def _look(self, frame: int, image: Tensor, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What the model shows at places (N, 2) of images (N,) of a frame.

        Returns:
            The mean canonical point (N, 3), the colour (N, 3) on white, and Σ w_i (N,).
        """
        model, deformation = self.model, self.model.deformation
        assert deformation is not None
        time = deformation.clock.times[frame]
        seen = render(
            model.space.rays(self.views.cameras.rays(image, place)),
            model.canonical,
            self._occupancy(frame, time),
            model.settings,
            torch.ones(3, device=image.device),
            model.warp(time),
        )
        count, ray = len(image), seen.samples.ray
        mass = sum_by_ray(seen.weight, ray, count)
        point = sum_by_ray(seen.weight[:, None] * seen.canonical, ray, count)
        return point / mass[:, None], seen.color, mass

    def _occupancy(self, frame: int, time: float) -> Occupancy:
        """The occupancy of a frame, which no longer changes; the newest ones are kept."""
        if frame not in self._occupancies:
            self._occupancies[frame] = self.model.occupancy_at(time)
            self._occupancies.pop(frame - self.farthest, None)
        return self._occupancies[frame]
