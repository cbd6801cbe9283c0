"""The common base of D-NeRF, Nerfies and HyperNeRF: a deformation before one radiance field."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.geometry.rays import Rays
from devrf.methods.nerf.networks import RadianceField
from devrf.methods.nerf.placed_model import DensityColorField, Sigma
from devrf.methods.nerf.samples import RaySamples, flattened, importance, limits, stratified
from devrf.methods.nerf.settings import FieldSettings
from devrf.ops.compositing import composite
from devrf.rendering.output import RenderOutput


class DeformableField(DensityColorField):
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
        """Deformed points, in normalised space.

        Args:
            points: (S, 3) x.
            time: (S,) in [0, 1].

        Returns:
            x′ (S, 3), and the further input of T, (S, ambient) or None.
        """

    def backward_warp(self, time: float) -> Callable[[Tensor], Tensor]:
        """x → x′, without w."""

        def mapped(points: Tensor) -> Tensor:
            place = self.placement
            times = torch.full_like(points[:, 0], time)
            return place.fields(self.deform(place.normalised(points), times)[0])

        return mapped

    def radiance_parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The radiance fields as parts; layers that take w are a part of their own."""
        base: list[nn.Parameter] = []
        beside: list[nn.Parameter] = []
        for field in (self.canonical, self.coarse):
            for name, parameter in field.named_parameters() if field is not None else ():
                (beside if name.startswith("trunk.beside.") else base).append(parameter)
        return {"canonical": base, "canonical_ambient": beside} if beside else {"canonical": base}

    def sigma(
        self, points: Tensor, time: Tensor, ray: Tensor, field: RadianceField | None = None
    ) -> tuple[Tensor, Tensor]:
        """σ (S,) at deformed points, in T or another ``field``, and the colours' features."""
        canonical, ambient = self.deform(points, time.index_select(0, ray))
        return (field or self.canonical).sigma(canonical, ambient)

    def rgb(self, features: Tensor, viewdirs: Tensor, ray: Tensor) -> Tensor:
        """RGB (S, 3) of T."""
        return self.canonical.rgb(features, viewdirs, ray)

    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> RenderOutput:
        """The render of even samples, and of more where these have weight, if not by occupancy.

        If a coarse field learns, ``extras`` also has ``coarse_color`` (R, 3), and the entries of
        the fine samples with ``coarse_`` before their names.
        """
        s = self.settings
        if s.sampling == "occupancy":
            return super().render_rays(rays, time, background, jitter=jitter)
        near, far = limits(rays, self.box, self.depth_limits)
        distance = stratified(near, far, s.coarse, jitter=jitter)
        samples = flattened(rays, distance, far)
        sigma = partial(self.sigma, field=self.coarse)
        beside: dict[str, Tensor] = {}
        if self.coarse is not None and jitter:
            coarse = self.rendered(
                samples, rays, time, background, sigma=sigma, rgb=self.coarse.rgb
            )
            beside = {f"coarse_{name}": value for name, value in coarse.extras.items()}
            beside["coarse_color"] = coarse.color
            weight = coarse.extras["weight"].detach()
        else:
            weight = self._weights(samples, time, sigma)
        with torch.no_grad():
            drawn = importance(distance, weight.view_as(distance), near, far, s.fine, jitter=jitter)
            distance, _ = torch.cat([distance, drawn], dim=1).sort(dim=1)
        fine = self.rendered(flattened(rays, distance, far), rays, time, background)
        return replace(fine, extras={**fine.extras, **beside})

    @torch.no_grad()
    def _weights(self, samples: RaySamples, time: Tensor, sigma: Sigma) -> Tensor:
        """Weights (S,) of samples, from their densities alone."""
        samples = samples.normalised(self.placement)
        density, _ = sigma(samples.points, time, samples.ray)
        return composite(density * samples.length, samples.ray, samples.rays)[0]

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``render``: the mean squared error, and that of the coarse colours where these learn."""
        if "render" not in names:
            return {}
        terms = super().loss_terms(output, batch, names)
        coarse = output.extras.get("coarse_color")
        if coarse is not None:
            terms["render"] = terms["render"] + nn.functional.mse_loss(coarse, batch.color)
        return terms
