"""Priors of training images beside their colours: flow both ways, depth, and motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from devrf.data.batch import PixelPool, RayBatch, wanted_pixels
from devrf.geometry.space import Space
from devrf.methods.nsff.fields import FORWARD
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import OpticalFlow, Views

# A pixel is in the motion mask where its flow is longer than this, in pixels.
MOVING = 1.0


class ImagePriors:
    """Flow, depth and neighbours of the images that rays are drawn from, numbered through.

    Attributes:
        cameras: of all images.
        neighbour: (N, 2) int64, the image one frame later and the one before in the same view; its
            own number where there is none.
        moving: the pixels of fixed cameras that move; None if no such pixel is known.
    """

    def __init__(self, views: Sequence[Views], space: Space) -> None:
        """Look at the images.

        Args:
            views: of each capture, on one device.
            space: the fields' space.
        """
        self._views = tuple(views)
        self._space = space
        first, *others = (view_set.cameras for view_set in views)
        self.cameras = first.joined(*others)
        self.neighbour = torch.arange(len(self.cameras))[:, None].repeat(1, 2)
        # The number of each capture's first image.
        self._offsets = [sum(map(len, views[:k])) for k in range(len(views))]
        pools = []
        for view_set, offset in zip(views, self._offsets, strict=True):
            for image, earlier in frame_pairs(view_set):
                self.neighbour[earlier + offset, 0] = image + offset
                self.neighbour[image + offset, 1] = earlier + offset
            if (pool := _moving(view_set)) is not None:
                pools.append(PixelPool(torch.stack([pool.image + offset, pool.flat])))
        self.neighbour = self.neighbour.to(views[0].times.device)
        self.moving = None
        if pools:
            self.moving = PixelPool(torch.cat([pool.pixels for pool in pools], dim=1))

    @property
    def has_flow(self) -> tuple[bool, bool]:
        """Whether some image has forward flow, and whether some has backward flow."""
        has_flow = [[_known(_flow(view_set, side)) for view_set in self._views] for side in (0, 1)]
        return any(has_flow[0]), any(has_flow[1])

    @property
    def has_depth(self) -> bool:
        """Whether some image has depth that rays of the fields' space can be compared with."""
        return self._space.is_linear and any(view_set.depth is not None for view_set in self._views)

    def flow(self, batch: RayBatch, side: int) -> tuple[Tensor, Tensor]:
        """Optical flow (R, 2) in pixels of a batch's rays, and (R,) bool where it is known.

        Args:
            batch: rays of these images.
            side: ``FORWARD`` or ``BACKWARD``.
        """
        vectors = torch.zeros_like(batch.pixel)
        valid = torch.zeros_like(batch.time, dtype=torch.bool)

        for views, ray, row in self._captures(batch):
            if (flow := _flow(views, side)) is not None:
                valid[ray] = flow.valid.flatten()[row]
                vectors[ray] = flow.vectors.flatten(0, 2)[row]
        # An observation that is not valid may be anything, NaN included.
        return torch.where(valid[:, None], vectors, 0.0), valid

    def distance(self, batch: RayBatch) -> Tensor:
        """Distances (R,) of surfaces along a batch's rays, in their own units; inf: unknown."""
        depth = torch.full_like(batch.time, torch.inf)
        for views, ray, row in self._captures(batch):
            if views.depth is not None:
                depth[ray] = views.depth.flatten()[row]
        finite = depth.isfinite()
        world = self.cameras.rays(batch.image, batch.pixel)
        points = world.origins + world.directions * torch.where(finite, depth, 1.0)[:, None]
        along = batch.rays.directions
        away = self._space.from_world(points) - batch.rays.origins
        distance = (away * along).sum(dim=1) / along.square().sum(dim=1)
        return torch.where(finite, distance, torch.inf)

    def _captures(self, batch: RayBatch) -> Iterator[tuple[Views, Tensor, Tensor]]:
        """Each capture's views, the batch's rays in it, and their pixels' numbers among all."""
        column, line = batch.pixel.long().unbind(1)
        for views, offset in zip(self._views, self._offsets, strict=True):
            in_capture = (batch.image >= offset) & (batch.image < offset + len(views))
            ray = in_capture.nonzero()[:, 0]
            image = batch.image[ray] - offset
            yield views, ray, (image * views.height + line[ray]) * views.width + column[ray]


def _flow(views: Views, side: int) -> OpticalFlow | None:
    return views.forward_flow if side == FORWARD else views.flow


def _known(flow: OpticalFlow | None) -> bool:
    return flow is not None and bool(flow.valid.any())


def _moving(views: Views) -> PixelPool | None:
    """The pixels whose flow is longer than ``MOVING``, if the cameras are fixed."""
    if len(set(views.view.tolist())) == len(views):
        return None
    wanted = torch.zeros(len(views), views.height * views.width, dtype=torch.bool)
    wanted = wanted.to(views.times.device)
    for flow in (views.flow, views.forward_flow):
        if flow is not None:
            long = flow.vectors.norm(dim=-1) > MOVING
            wanted |= (flow.valid & long).flatten(1)
    images = torch.arange(len(views), device=wanted.device)
    pool = wanted_pixels(views, images, wanted)
    return pool if len(pool) else None
