"""A DeVRF scene at one time, ready to be rendered; and its surface at rest."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.geometry.space import Space
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.deformation_field import DeformationField, GridWarp
from devrf.methods.devrf.losses import induced_flow
from devrf.methods.devrf.volume_rendering import deformed_occupancy, render
from devrf.ops.compositing import LEAST_MASS, sum_by_ray
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorResidual, RenderedImage
from devrf.rendering.sampling import RenderSettings
from devrf.system.threads import one_thread

# Rays at once: on a CPU so many that the cost of a chunk by itself, 0.8 ms, is small
# (docs/notebook/costs.md#tiles); a GPU is kept busy, and they fit.
ON_CPU = 2**14
ON_GPU = 2**15
# Points of a grid that are worth several threads.
MANY = 2**20
# Samples of unbounded scenes' pictures are so much further apart than in training: far things are
# blurred over many voxels. Their PSNR stays, and a fifth of the time is saved.
UNBOUNDED_STEP = 1.5


@dataclass
class DeVRFView:
    """The occupancy and the displacements of one time t; it shares the fields' memory.

    Attributes:
        canonical: the scene's look at rest.
        occupancy: given as of the scene at rest; kept as of the view's time.
        settings: of the sampling of rays.
        deformation: the scene's; None: it is at rest at every time.
        space: the space that the fields live in.
        time: t in [0, 1].
        color_residual: q → A_t(q) at that time; None: it is zero.
        at_rest: whether the warps of this time are the identity.
    """

    canonical: CanonicalField
    occupancy: Occupancy
    settings: RenderSettings
    deformation: DeformationField | None
    space: Space
    time: float
    color_residual: ColorResidual | None = None
    at_rest: bool = field(init=False)
    _backward_warp: GridWarp | None = field(init=False, default=None)

    @torch.no_grad()
    def __post_init__(self) -> None:
        """Blend the time's displacements; find its occupancy, and the distances to it."""
        deformation = self.deformation
        self.at_rest = deformation is None or deformation.clock.at(self.time).after == 0
        if deformation is None or self.at_rest:
            return
        with one_thread() if self.canonical.density.values.numel() < MANY else nullcontext():
            # As one grid: one interpolation a point instead of two.
            moves = deformation.backward_warp(self.time).displacement
            assert moves is not None
            self._backward_warp = deformation.warp_by(moves)
            self.occupancy = deformed_occupancy(
                self.canonical, self.occupancy, self.picture_settings, self._backward_warp
            )
            self.occupancy.find_distances()

    @property
    def chunk(self) -> int:
        """Rays that are best rendered at once."""
        return ON_GPU if self.canonical.density.values.is_cuda else ON_CPU

    @property
    def picture_settings(self) -> RenderSettings:
        """The settings by which rays of pictures are sampled."""
        if self.space.is_linear:
            return self.settings
        return replace(self.settings, step=UNBOUNDED_STEP * self.settings.step)

    @torch.no_grad()
    def render(self, rays: Rays, background: Tensor) -> RenderedImage:
        """The render of R rays in the fields' space."""
        output = render(
            rays,
            self.canonical,
            self.occupancy,
            self.picture_settings,
            background,
            self._backward_warp,
            color_residual=self.color_residual,
        )
        return RenderedImage.of(output)

    @torch.no_grad()
    def induced_flow(
        self, rays: Rays, pixels: Tensor, cameras: Cameras, time: float
    ) -> tuple[Tensor, Tensor]:
        """Σ w_i φ_i / Σ w_i (R, 2) of R rays back to ``time``, and Σ w_i (R,).

        See docs/method.md#flow for φ_i, with ``time`` in place of t − 1.
        """
        black = torch.zeros(3, device=rays.origins.device)
        seen = render(
            rays, self.canonical, self.occupancy, self.settings, black, self._backward_warp
        )
        ray, weight = seen.samples.ray, seen.samples.weight
        forward = GridWarp((), self.canonical.box)
        if self.deformation is not None:
            forward = self.deformation.forward_warp(time)
        moved = induced_flow(
            seen.samples.canonical, forward, cameras, torch.zeros_like(ray), pixels[ray], self.space
        )
        mass = sum_by_ray(weight, ray, len(rays))
        total = sum_by_ray(weight[:, None] * moved, ray, len(rays))
        return total / mass.clamp(min=LEAST_MASS)[:, None], mass


@dataclass(frozen=True)
class CanonicalSurface:
    """The radiance field at rest, as :class:`~devrf.rendering.view.SurfaceField`.

    Opacities are those of a voxel of the full grid (docs/method.md#step-length).
    """

    field: CanonicalField
    occupancy: Occupancy

    @property
    def box(self) -> Box:
        """The field's box."""
        return self.field.box

    @property
    def shape(self) -> tuple[int, int, int]:
        """The density grid's points along x, y, z."""
        return self.field.density.shape

    @torch.no_grad()
    def optical_depth(self, points: Tensor) -> Tensor:
        """τ (M,) of one voxel, 0 in cells that are known to be empty."""
        depth = self.field.optical_depth(points, self.field.step_in_base_voxels(1.0))
        return torch.where(self.occupancy.at(points), depth, 0.0)

    @torch.no_grad()
    def color(self, points: Tensor, viewdirs: Tensor) -> Tensor:
        """RGB (M, 3) of points, each seen in its own direction."""
        return self.field.rgb(points, viewdirs, torch.arange(len(points), device=points.device))
