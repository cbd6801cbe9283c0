"""Renders pictures in few kernel launches, on lists of fixed length, where Triton runs.

Shows what :func:`devrf.methods.devrf.volume_rendering.render` shows, without gradients.
"""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.methods.devrf.appearance import ColorResidual
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.methods.devrf.settings import RenderSettings
from devrf.methods.devrf.static_shape.sample_search import search
from devrf.ops.compositing import composite_colors, composite_segments
from devrf.ops.search import PackedSamples, select_listed
from devrf.ops.warped_depth import warped_depth
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import RenderedImage

# Lists are made this much longer than the present picture needs.
SPARE = 1.25


class ListRenderer:
    """Renders a field, moved or at rest; its lists grow to the length that pictures need.

    Attributes:
        field: the canonical field.
        settings: step length and thresholds.
        half: whether the colour network works in half precision (CUDA only).
    """

    def __init__(
        self, field: CanonicalField, settings: RenderSettings, *, half: bool = False
    ) -> None:
        self.field = field
        self.settings = settings
        self.half = half
        self._capacity = 0

    @torch.no_grad()
    def picture(
        self,
        rays: Rays,
        occupancy: Occupancy,
        displacement: Tensor | None,
        background: Tensor,
        appearance: ColorResidual | None = None,
    ) -> RenderedImage:
        """What rays see.

        Args:
            rays: R rays in the field's space.
            occupancy: where something is at their time.
            displacement: (X, Y, Z, 3) over the field's box, their time's points → canonical
                space; None at rest.
            background: (3,) or (R, 3) RGB.
            appearance: q → A_t(q), added to the colours' logits; None: nothing is.
        """
        field = self.field
        warp = GridWarp(() if displacement is None else (displacement,), field.box)
        found = self._search(rays, occupancy, warp)
        canonical, tau = warped_depth(
            found.points,
            field.density.values,
            warp.slices,
            box=field.box,
            shift=field.shift,
            delta=field.step_in_base_voxels(self.settings.step),
        )
        weight, left = composite_segments(tau, found.first)
        chosen = select_listed(found, canonical, weight, len(found.ray))
        used = int(chosen.total)
        precision = torch.float16 if self.half and tau.is_cuda else torch.float32
        points, ray = chosen.canonical[:used], chosen.ray[:used]
        residual = None if appearance is None else appearance(points)
        color = field.rgb(points, rays.viewdirs, ray, precision, residual, chosen.first)
        listed = chosen.weight[:used], color, chosen.distance[:used], chosen.first
        image, depth = composite_colors(*listed, left, background)
        return RenderedImage(color=image, depth=depth, opacity=1 - left)

    def _search(self, rays: Rays, occupancy: Occupancy, warp: GridWarp) -> PackedSamples:
        """The samples that can be seen, in lists without padding."""
        while True:
            found = search(
                rays,
                self.field,
                occupancy,
                self.settings,
                warp,
                capacity=self._capacity,
                wait=True,
            )
            total = int(found.total)
            if total <= self._capacity:
                return found.head(total)
            self._capacity = int(SPARE * total)
