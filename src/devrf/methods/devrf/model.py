"""A whole scene that can be rendered: canonical field, its occupancy, and how it deforms."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.volume_rendering import RenderSettings, Warp, render
from devrf.rendering.chunks import in_chunks
from devrf.rendering.occupancy import Occupancy, dilate
from devrf.rendering.rendered_image import RenderedImage


class SceneModel(nn.Module):
    """What is needed to see a scene from any view at any time.

    Attributes:
        canonical: what the scene looks like at rest.
        occupancy: where something is at rest.
        deformation: how it moves; None shows the rest state at every time.
        settings: how rays are sampled.
        space: the space that the fields live in.
    """

    def __init__(
        self,
        canonical: CanonicalField,
        occupancy: Occupancy,
        settings: RenderSettings,
        deformation: DeformationField | None = None,
        space: Space = WORLD,
    ) -> None:
        super().__init__()
        self.canonical = canonical
        self.occupancy = occupancy
        self.settings = settings
        self.deformation = deformation
        self.space = space

    def at_rest(self) -> SceneModel:
        """The canonical field alone, sharing its memory: the rest state at every time."""
        return SceneModel(self.canonical, self.occupancy, self.settings, space=self.space)

    def warp(self, time: float) -> Warp | None:
        """The map from points (M, 3) at ``time`` into canonical space; None is the identity."""
        deformation = self.deformation
        if deformation is None or deformation.clock.at(time).after == 0:
            return None
        return deformation.warp_at(time)

    def occupancy_at(self, time: float) -> Occupancy:
        """Where something is at ``time`` in [0, 1]."""
        warp = self.warp(time)
        return self.occupancy if warp is None else deformed_occupancy(self, warp)

    @torch.no_grad()
    def picture(
        self, rays: Rays, time: float, background: Tensor, chunk: int = 16384
    ) -> RenderedImage:
        """What rays see at ``time``: the plain way, which keeps nothing for another picture.

        :class:`~devrf.methods.devrf.renderer.Renderer` is the quick one.

        Args:
            rays: R rays in world space.
            time: in [0, 1].
            background: (3,) RGB.
            chunk: rays rendered at once; fewer when memory runs out.
        """
        rays = self.space.rays(rays)
        warp, occupancy = self.warp(time), self.occupancy_at(time)
        parts = in_chunks(
            lambda some: render(some, self.canonical, occupancy, self.settings, background, warp),
            rays,
            chunk,
        )
        return RenderedImage.joined([RenderedImage.of(part) for part in parts])


@torch.no_grad()
def deformed_occupancy(model: SceneModel, warp: Warp) -> Occupancy:
    """Where something is once it has moved: the grid points that the warp sends to matter.

    Args:
        model: gives the canonical occupancy and the box.
        warp: maps points (M, 3) at the time in question into canonical space.
    """
    points = occupancy_points(model)
    return occupancy_through(model, warp(points.view(-1, 3)).view(points.shape))


def occupancy_points(model: SceneModel) -> Tensor:
    """The grid points (X, Y, Z, 3) at which a moment's occupancy is looked at."""
    x, y, z = model.occupancy.mask.shape
    return model.canonical.box.grid_points((x, y, z), model.canonical.density.values)


@torch.no_grad()
def occupancy_through(model: SceneModel, canonical: Tensor) -> Occupancy:
    """The occupancy of a moment whose grid points are seen at ``canonical`` (X, Y, Z, 3).

    The canonical occupancy has a rim of one grid point, for what a stretching warp would step
    over; so has the result, for what lies between its own grid points.
    """
    found = model.occupancy.at(canonical.view(-1, 3)).view(canonical.shape[:3])
    return Occupancy(dilate(found, 1), model.canonical.box)
