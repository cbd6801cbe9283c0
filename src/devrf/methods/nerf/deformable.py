"""What D-NeRF, Nerfies and HyperNeRF are: a deformation before one radiance field."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterable
from dataclasses import replace

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.geometry.rays import Rays
from devrf.methods.nerf.networks import RadianceField
from devrf.methods.nerf.placed_model import SurfacedField
from devrf.methods.nerf.samples import (
    RaySamples,
    flattened,
    importance,
    limits,
    stratified,
    volume_render,
)
from devrf.methods.nerf.settings import FieldSettings
from devrf.ops.compositing import composite
from devrf.rendering.output import RenderOutput


class DeformableField(SurfacedField):
    """(σ, c) = T(x′, w, d), where a deformation leads a point x at time t to x′ and w.

    A method defines the deformation (:meth:`deform`). T lives in normalised space.

    Attributes:
        canonical: T.
        coarse: a T of its own for the coarse samples, if the settings ask for one.
    """

    settings: FieldSettings
    coarse: RadianceField | None

    def __init__(self, settings: FieldSettings, ambient: int = 0) -> None:
        """Build the radiance field.

        Args:
            settings: sizes and sampling.
            ambient: length of w as it enters T; 0: there is none.
        """
        super().__init__(settings)
        self.canonical = RadianceField(settings, ambient=ambient)
        self.coarse = RadianceField(settings, ambient=ambient) if settings.separate_coarse else None
        self.place()

    @abstractmethod
    def deform(self, points: Tensor, time: Tensor) -> tuple[Tensor, Tensor | None]:
        """Where points lead, in normalised space.

        Args:
            points: (S, 3) x.
            time: (S,) in [0, 1].

        Returns:
            x′ (S, 3), and what enters T beside it, (S, ambient) or None.
        """

    def radiance_parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The radiance fields as parts; what takes w is a part of its own."""
        base: list[nn.Parameter] = []
        beside: list[nn.Parameter] = []
        for field in (self.canonical, self.coarse):
            for name, parameter in field.named_parameters() if field is not None else ():
                (beside if name.startswith("trunk.beside.") else base).append(parameter)
        return {"canonical": base, "canonical_ambient": beside} if beside else {"canonical": base}

    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> RenderOutput:
        """What rays see, and samples.

        ``extras`` has ``points`` (S, 3) x in normalised space, ``time``, ``ray`` and ``weight``
        (S,) of the S samples. If a coarse field learns, it also has ``coarse_color`` (R, 3), and
        the same of the coarse samples with ``coarse_`` before their names.
        """
        if self.settings.sampling == "occupancy":
            samples = self.march(rays, time, jitter=jitter)
            return self._rendered(self.canonical, samples, rays, time, background)
        samples, coarse = self._by_weight(rays, time, background, jitter=jitter)
        fine = self._rendered(self.canonical, samples, rays, time, background)
        if coarse is None:
            return fine
        beside = {f"coarse_{name}": value for name, value in coarse.extras.items()}
        return replace(fine, extras={**fine.extras, "coarse_color": coarse.color, **beside})

    def _rendered(
        self,
        field: RadianceField,
        samples: RaySamples,
        rays: Rays,
        time: Tensor,
        background: Tensor,
    ) -> RenderOutput:
        """The render of samples in a radiance field."""
        if not self.space.is_linear:
            samples = samples.unbounded()
        points = self.placement.normalised(samples.points)
        when = time.index_select(0, samples.ray)
        canonical, ambient = self.deform(points, when)
        density, color = field(canonical, rays.viewdirs, samples.ray, ambient)
        scaled = samples.scaled(self.placement.half_edge)
        output = volume_render(scaled, density, color, background)
        return replace(output, extras={**output.extras, "points": points, "time": when})

    def _by_weight(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool
    ) -> tuple[RaySamples, RenderOutput | None]:
        """Even samples and more where these have weight; the render of a learning coarse field."""
        s = self.settings
        field = self.coarse or self.canonical
        near, far = limits(rays, self.box, self.depth_limits)
        distance = stratified(near, far, s.coarse, jitter=jitter)
        first = flattened(rays, distance, far)
        output = None
        if self.coarse is not None and jitter:
            output = self._rendered(field, first, rays, time, background)
            weight = output.extras["weight"].detach()
        else:
            weight = self._weights(field, first, time)
        with torch.no_grad():
            drawn = importance(distance, weight.view_as(distance), near, far, s.fine, jitter=jitter)
            distance, _ = torch.cat([distance, drawn], dim=1).sort(dim=1)
        return flattened(rays, distance, far), output

    @torch.no_grad()
    def _weights(self, field: RadianceField, samples: RaySamples, time: Tensor) -> Tensor:
        """Weights (S,) of samples, from their densities alone."""
        points = self.placement.normalised(samples.points)
        when = time.index_select(0, samples.ray)
        canonical, ambient = self.deform(points, when)
        density = field.sigma(canonical, ambient)
        length = samples.length / self.placement.half_edge
        weight, _ = composite(density * length, samples.ray, samples.rays)
        return weight

    def optical_depth(self, points: Tensor, time: Tensor, length: float) -> Tensor:
        """τ (S,) of the canonical field, where the points lead."""
        canonical, ambient = self.deform(points, time)
        return self.canonical.sigma(canonical, ambient) * length

    def point_colors(self, points: Tensor, viewdirs: Tensor, time: Tensor) -> Tensor:
        """RGB (S, 3) of the canonical field, where the points lead."""
        canonical, ambient = self.deform(points, time)
        each = torch.arange(len(points), device=points.device)
        color: Tensor = self.canonical(canonical, viewdirs, each, ambient)[1]
        return color

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``color``: the mean squared error, and that of the coarse colours where these learn."""
        if "color" not in names:
            return {}
        terms = super().loss_terms(output, batch, names)
        coarse = output.extras.get("coarse_color")
        if coarse is not None:
            terms["color"] = terms["color"] + nn.functional.mse_loss(coarse, batch.color)
        return terms
