"""K-Planes (Fridovich-Keil et al., CVPR 2023): space and time on six planes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any, ClassVar, cast

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.geometry.box import constant
from devrf.geometry.rays import Rays
from devrf.methods.kplanes.decoders import ExplicitDecoder, HybridDecoder
from devrf.methods.kplanes.planes import SixPlanes, sum_of
from devrf.methods.kplanes.proposals import Proposal, drawn_edges, histogram_error, intervals
from devrf.methods.kplanes.settings import KPlanesSettings
from devrf.methods.nerf.placed_model import DensityColorField
from devrf.methods.nerf.samples import limits
from devrf.ops.compositing import composite
from devrf.ops.photometric import distortion
from devrf.rendering.output import RenderOutput
from devrf.system.options import Share

# Proposals learn in the first iterations, then ever less often, in the end in one of so many.
FIRST = 10
RARELY = 5
# The exponent of weights is SLOPE f / ((SLOPE − 1) f + 1), f growing to 1.
SLOPE = 10


class KPlanes(DensityColorField):
    """(σ, c) = R(f(x, t), d): features f of six planes, decoded (docs/methods/kplanes.md).

    Attributes:
        planes: f.
        proposals: the fields of the rounds, where these tell the samples.
        sharpness: the exponent of the weights by which samples are drawn.
    """

    name: ClassVar[str] = "kplanes"
    losses: ClassVar[tuple[str, ...]] = (
        "render", "tv", "smooth", "change", "smooth_proposals", "histogram", "distortion",
    )  # fmt: skip
    random_background: ClassVar[bool] = True
    keeps_batches: ClassVar[bool] = True  # large steps need whole ones
    settings_class = KPlanesSettings
    checkpointed_attributes: ClassVar[Mapping[str, Any]] = {"sharpness": Share}
    settings: KPlanesSettings

    def __init__(self, settings: KPlanesSettings | None = None) -> None:
        """Build planes and decoder, as published if no settings are given."""
        s = settings or KPlanesSettings()
        super().__init__(s)
        self.sharpness = 1.0
        self._teaches = True
        self.place()
        decoder = HybridDecoder if s.decoder == "hybrid" else ExplicitDecoder
        self.decoder = decoder(self.planes.size, s)

    def set_times(self, times: tuple[float, ...]) -> None:
        """Take the frames' times, and draw planes for so many."""
        super().set_times(times)
        s = self.settings
        points = s.time_resolution or max(2, len(times) // 2)
        sides = [scale * s.resolution for scale in s.scales]
        device = self.occupancy.mask.device
        self.planes = SixPlanes(s.channels, sides, points, pairing=s.pairing).to(device)
        rounds = s.proposal_resolutions if s.sampling == "proposals" else ()
        self.proposals = nn.ModuleList(Proposal(side, points, s) for side in rounds).to(device)

    def milestones(self, total: int) -> dict[str, int]:
        """Iterations from which weights are sharpest, and proposals learn most rarely."""
        s = self.settings
        changes = {"weights sharpened": s.annealing, "proposals learn rarely": s.teaching}
        last = {k: n for k, n in changes.items() if n < total and s.sampling == "proposals"}
        return {**super().milestones(total), **last}

    def on_iteration(self, step: int, total: int) -> None:
        """Sharpen the rounds' weights, let proposals learn ever less often, skip empty space."""
        super().on_iteration(step, total)
        s = self.settings
        done = min(1.0, step / s.annealing)
        self.sharpness = SLOPE * done / ((SLOPE - 1) * done + 1)
        every = round(1 + (RARELY - 1) * min(1.0, step / s.teaching))
        self._teaches = step < FIRST or step % every == 0

    def coordinates(self, points: Tensor, time: Tensor) -> Tensor:
        """[0, 1]⁴ (S, 4) of points (S, 3) in normalised space, and of times (S,)."""
        edges = tuple(edge / self.placement.half_edge for edge in self.box.size)
        share = points / constant(edges, points.dtype, points.device) + 0.5
        return torch.cat([share, time[:, None]], dim=1)

    def sigma(self, points: Tensor, time: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
        """σ (S,), and the decoder's features for colours."""
        where = self.coordinates(points, time.index_select(0, ray))
        return self.decoder.density(self.planes(where))

    def rgb(self, features: Tensor, viewdirs: Tensor, ray: Tensor) -> Tensor:
        """RGB (S, 3)."""
        return self.decoder.rgb(features, viewdirs, ray)

    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> RenderOutput:
        """The render of rays.

        ``extras`` also has ``histogram`` (), the error of the rounds of proposals, and the samples'
        ``length`` (K,), in units of the ray's direction.
        """
        if self.settings.sampling == "occupancy":
            return super().render_rays(rays, time, background, jitter=jitter)
        edges, rounds = self._proposed(rays, time, jitter=jitter)
        output = self.rendered(intervals(rays, edges), rays, time, background)
        weight = output.extras["weight"].view(len(rays), -1)
        errors = [histogram_error(edges, weight, before, proposed) for before, proposed in rounds]
        further = {"histogram": sum_of(errors), "length": edges.diff(dim=1).reshape(-1)}
        return replace(output, extras={**output.extras, **further})

    def _proposed(
        self, rays: Rays, time: Tensor, *, jitter: bool
    ) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
        """Edges (R, N + 1) of the samples' intervals; edges and weights (R, M) of each round."""
        s = self.settings
        near, far = limits(rays, self.box, self.depth_limits)
        edges = torch.stack([near, far], dim=1)
        weight = torch.zeros_like(edges[:, :1])
        rounds: list[tuple[Tensor, Tensor]] = []
        for proposal, count in zip(self.proposals, s.proposal_samples, strict=True):
            edges = drawn_edges(edges, weight, count, jitter=jitter)
            samples = intervals(rays, edges).normalised(self.placement)
            where = self.coordinates(samples.points, time.index_select(0, samples.ray))
            with torch.set_grad_enabled(torch.is_grad_enabled() and self._teaches):
                depth = proposal(where) * samples.length
                proposed, _ = composite(depth, samples.ray, samples.rays)
            rounds.append((edges, proposed.view(len(rays), count)))
            weight = rounds[-1][1].detach() ** self.sharpness
        return drawn_edges(edges, weight, s.samples, jitter=jitter), rounds

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``render``, and terms that keep planes simple and proposals true.

        See docs/methods/kplanes.md#losses. ``tv`` and ``change`` are of the field's planes and of
        proposals'. Without proposals their terms are 0.
        """
        rounds = [proposal.planes for proposal in cast("list[Proposal]", [*self.proposals])]
        extras = output.extras
        # Of a unit of each ray's direction, which has some other length in NDC.
        unit = batch.rays.directions.norm(dim=1)
        pace = unit[extras["ray"]] / self.placement.half_edge
        # Even steps are as long for the longest.
        even = self.step_length / unit.max()
        length = extras.get("length", even.expand_as(pace))
        terms: dict[str, Callable[[], Tensor]] = {
            "render": lambda: nn.functional.mse_loss(output.color, batch.color),
            "tv": lambda: sum_of([each.total_variation() for each in (self.planes, *rounds)]),
            "smooth": self.planes.roughness,
            "change": lambda: sum_of([each.change() for each in (self.planes, *rounds)]),
            "smooth_proposals": lambda: sum_of([nothing, *(each.roughness() for each in rounds)]),
            "histogram": lambda: extras.get("histogram", nothing),
            "distortion": lambda: distortion(
                extras["weight"],
                extras["distance"] * pace,
                extras["ray"],
                len(batch.time),
                length=length * pace,
            ),
        }
        nothing = output.color.new_zeros(())
        return {name: terms[name]() for name in self.losses if name in names}

    @property
    def grid_channels(self) -> Collection[int]:
        """Channels of the field's planes, and of proposals'."""
        s = self.settings
        return (s.channels, *([s.proposal_channels] if s.sampling == "proposals" else []))

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """Planes of space, with the decoder; planes with time; the proposals."""
        return {
            "canonical": [*self.planes.space, *self.decoder.parameters()],
            "motion": self.planes.time,
            "proposals": self.proposals.parameters(),
        }
