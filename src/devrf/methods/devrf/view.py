"""A DeVRF scene at one time, ready to be rendered."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.geometry.space import Space
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.deformation_field import (
    DeformationField,
    GridWarp,
    occupancy_points,
    occupancy_through,
)
from devrf.methods.devrf.losses import induced_flow
from devrf.methods.devrf.volume_rendering import render
from devrf.ops.compositing import sum_by_ray
from devrf.ops.corners import shape_of
from devrf.ops.dispatch import triton_runs
from devrf.ops.trilinear import resample
from devrf.rendering.list_rendering import ListRenderer
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorChange, RenderedImage

# Rays at once: on a CPU what its caches hold, on a GPU what keeps it busy and fits.
ON_CPU, ON_GPU, IN_LISTS = 8192, 2**15, 2**18


class DeVRFView:
    """The occupancy and the displacements of one time t; it shares the fields' memory.

    Attributes:
        at_rest: whether the warp of this time is the identity.
        occupancy: where something is.
        displacement: Δ_b(·, t) (X, Y, Z, 3) over the deformation field's box; None at rest.
    """

    @torch.no_grad()
    def __init__(
        self,
        canonical: CanonicalField,
        occupancy: Occupancy,
        deformation: DeformationField | None,
        lists: ListRenderer,
        space: Space,
        time: float,
        color_change: ColorChange | None = None,
    ) -> None:
        """Blend the displacements of a time, and find its occupancy.

        Args:
            canonical: what the scene looks like at rest.
            occupancy: where something is at rest.
            deformation: how the scene moves; None: it is at rest at every time.
            lists: renders the canonical field where Triton runs; has its settings.
            space: the space that the fields live in.
            time: in [0, 1].
            color_change: what is added to the colours' logits at that time; None: nothing.
        """
        self._canonical = canonical
        self._lists, self._settings, self._space = lists, lists.settings, space
        self._motion = deformation
        self._color_change = color_change
        self.occupancy, self.displacement = occupancy, None
        self.at_rest = deformation is None or deformation.clock.at(time).after == 0
        self._warp: GridWarp | None = None
        if deformation is not None and not self.at_rest:
            self.displacement = deformation.blended(time)
            still_outside = deformation.still_outside
            self._warp = GridWarp(
                (self.displacement,), deformation.box, still_outside=still_outside
            )
            points = occupancy_points(occupancy, canonical.box)
            if still_outside:
                moved = self._warp(points.view(-1, 3)).view(points.shape)
            else:
                # Interpolation at the points of a grid over the same box is resampling, which is
                # several times faster.
                moved = points + resample(self.displacement, shape_of(points))
            self.occupancy = occupancy_through(occupancy, canonical.box, moved)

    @property
    def _in_lists(self) -> bool:
        """Whether lists of fixed length are rendered: their kernels take straight rays."""
        return self._space.is_linear and triton_runs(self._canonical.density.values)

    @property
    def chunk(self) -> int:
        """Rays that are best rendered at once."""
        density = self._canonical.density.values
        if self._in_lists:
            return IN_LISTS
        return ON_GPU if density.is_cuda else ON_CPU

    @torch.no_grad()
    def render(self, rays: Rays, background: Tensor) -> RenderedImage:
        """What R rays in the fields' space see."""
        if self._in_lists:
            return self._lists.picture(
                rays, self.occupancy, self.displacement, background, self._color_change
            )
        return RenderedImage.of(
            render(
                rays,
                self._canonical,
                self.occupancy,
                self._settings,
                background,
                self._warp,
                color_change=self._color_change,
            )
        )

    @torch.no_grad()
    def induced_flow(
        self, rays: Rays, pixels: Tensor, cameras: Cameras, time: float
    ) -> tuple[Tensor, Tensor]:
        """Σ w_i φ_i / Σ w_i (R, 2) of R rays back to ``time``, and Σ w_i (R,).

        See docs/method.md#flow for φ_i, with ``time`` in place of t − 1.
        """
        black = torch.zeros(3, device=rays.origins.device)
        seen = render(rays, self._canonical, self.occupancy, self._settings, black, self._warp)
        motion = self._motion

        def unwarp(points: Tensor) -> Tensor:
            return points if motion is None else motion.unwarp(points, time)

        ray, weight = seen.samples.ray, seen.weight
        moved = induced_flow(
            seen.canonical, unwarp, cameras, torch.zeros_like(ray), pixels[ray], self._space
        )
        mass = sum_by_ray(weight, ray, len(rays))
        total = sum_by_ray(weight[:, None] * moved, ray, len(rays))
        return total / mass.clamp(min=1e-6)[:, None], mass
