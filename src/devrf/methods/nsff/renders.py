"""The pictures of a batch that losses compare: blended, dynamic alone, and from other frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.methods.nerf.placement import Placement
from devrf.methods.nerf.samples import RaySamples
from devrf.methods.nsff.fields import (
    BACKWARD,
    FORWARD,
    Blend,
    DynamicSamples,
    StaticSamples,
    TwoFields,
)
from devrf.methods.nsff.priors import ImagePriors
from devrf.ops.compositing import composite, sum_by_ray
from devrf.rendering.output import RenderOutput


@dataclass(frozen=True, kw_only=True)
class BlendedOutput(RenderOutput):
    """A rendering of R rays from S samples, and its parts.

    Attributes:
        samples: their points and lengths in normalised space.
        static: the static field there.
        dynamic: the dynamic field there, at the rays' times.
        depths: (S,) optical depths of the dynamic and of the static field alone.
        blend: their weights.
    """

    samples: RaySamples
    static: StaticSamples
    dynamic: DynamicSamples
    depths: tuple[Tensor, Tensor]
    blend: Blend


@dataclass(frozen=True)
class Warp:
    """R rays of one frame rendered with the dynamic field of another: C_{j→i}.

    Attributes:
        exists: (R,) bool, whether that frame exists.
        frame: (R,) int64, the other frame j.
        side: (R,) int64, whether it comes after (``FORWARD``) or before (``BACKWARD``).
        sample: (K,) int64, the samples of the rays whose frame exists.
        ray: (K,) int64, theirs.
        moved: (K, 3) f_{i→j}, by which they were displaced last.
        occlusion: (K,) o_{i→j}.
        points: (K, 3) their positions in frame j.
        dynamic: the dynamic field there.
        color: (R, 3) RGB.
        weight: (K,) of the dynamic field.
    """

    exists: Tensor
    frame: Tensor
    side: Tensor
    sample: Tensor
    ray: Tensor
    moved: Tensor
    occlusion: Tensor
    points: Tensor
    dynamic: DynamicSamples
    color: Tensor
    weight: Tensor


@dataclass(frozen=True)
class Renders:
    """The renders of an iteration's loss terms; further ones are made when first asked for.

    Attributes:
        fields: the networks.
        placement: of the networks.
        times: (T,) of the frames.
        priors: of the images that the rays were drawn from; None where nothing is known.
        output: the batch as it was rendered.
        batch: R rays, and the truth at their pixels.
        step: the iteration.
        both: render from both neighbouring frames; else from one at random.
        weighted: weigh rays by their dynamic share: the first N₀ iterations are over.
        chains: whether flows are chained by now.
        prior_factor: the decayed factor of the weights of depth and flow priors.
    """

    fields: TwoFields
    placement: Placement
    times: Tensor
    priors: ImagePriors | None
    output: BlendedOutput
    batch: RayBatch
    step: int
    both: bool
    weighted: bool
    chains: bool
    prior_factor: float

    @property
    def rays(self) -> int:
        """R."""
        return len(self.batch.rays)

    @cached_property
    def dynamic_share(self) -> Tensor:
        """(R,) sg(Σ w_d), the dynamic share of each ray; 1 in the first N₀ iterations."""
        if not self.weighted:
            return torch.ones_like(self.batch.time)
        return sum_by_ray(self.output.blend.dynamic, self.output.samples.ray, self.rays).detach()

    @cached_property
    def alone(self) -> tuple[Tensor, Tensor]:
        """C_d (R, 3) and weights (S,) of the dynamic field without the static one."""
        samples = self.output.samples
        weight, end = composite(self.output.depths[0], samples.ray, self.rays)
        return self._color(weight, self.output.dynamic.color, samples.ray, end), weight

    @property
    def seen(self) -> tuple[Tensor, Tensor]:
        """Weights (S,) that depth and flow are rendered with, and the part of them that moves.

        They are those of the dynamic field alone, or of both fields if densities add.
        """
        if not self.fields.additive:
            return self.alone[1], self.alone[1]
        blend = self.output.blend
        return blend.dynamic + blend.static, blend.dynamic

    @cached_property
    def warps(self) -> list[Warp]:
        """The rays rendered from one or both neighbouring frames."""
        if self.both:
            sides = [torch.full_like(self.batch.frame, side) for side in (FORWARD, BACKWARD)]
        else:
            # At the ends of the recording there is one neighbour alone.
            side = (torch.rand_like(self.batch.time) < 0.5).long()
            side = torch.where(self.batch.frame == 0, FORWARD, side)
            sides = [torch.where(self.batch.frame == len(self.times) - 1, BACKWARD, side)]
        return [
            self._warp(
                side,
                frame=self.batch.frame,
                exists=torch.ones_like(self.batch.time, dtype=torch.bool),
                sample=torch.arange(len(self.output.samples.points), device=self.batch.time.device),
                points=self.output.samples.points,
                dynamic=self.output.dynamic,
            )
            for side in sides
        ]

    @property
    def near(self) -> Warp:
        """The rays rendered from a neighbouring frame: on either side by turns."""
        return self.warps[self.step % len(self.warps)]

    def chained(self) -> Warp:
        """The rays rendered from two frames away, flows chained, beyond :attr:`near`."""
        near = self.near
        return self._warp(
            near.side,
            frame=near.frame,
            exists=near.exists,
            sample=near.sample,
            points=near.points,
            dynamic=near.dynamic,
        )

    def _warp(
        self,
        side: Tensor,
        *,
        frame: Tensor,
        exists: Tensor,
        sample: Tensor,
        points: Tensor,
        dynamic: DynamicSamples,
    ) -> Warp:
        """One frame further to each ray's ``side`` (R,) from ``frame`` (R,), where there is one.

        The other arguments describe the samples at ``frame``, as a :class:`Warp` does.
        """
        samples = self.output.samples
        count = len(self.times)
        frame = frame + torch.where(side == FORWARD, 1, -1)
        exists = exists & (frame >= 0) & (frame < count)
        frame = frame.clamp(0, count - 1)
        going = exists[samples.ray[sample]].nonzero()[:, 0]
        sample = sample[going]
        ray = samples.ray[sample]
        toward = side[ray]
        moved = dynamic.flow[going, toward]
        occlusion = dynamic.occlusion[going, toward]
        points = points[going] + moved
        warped = self.fields.dynamic.at(
            points, self.times[frame[ray]], self.batch.rays.viewdirs, ray
        )
        color, weight = self._composited(warped, sample, ray)
        return Warp(
            exists=exists,
            frame=frame,
            side=side,
            sample=sample,
            ray=ray,
            moved=moved,
            occlusion=occlusion,
            points=points,
            dynamic=warped,
            color=color,
            weight=weight,
        )

    def _composited(
        self, dynamic: DynamicSamples, sample: Tensor, ray: Tensor
    ) -> tuple[Tensor, Tensor]:
        """C (R, 3) of samples with another frame's dynamic field, and its weights (K,).

        The static part stays as it is where densities add; else it is left out.
        """
        length = self.output.samples.length[sample]
        depth = self.fields.optical_depth(dynamic.raw, length, self.fields.noise(dynamic.raw))
        if not self.fields.additive:
            weight, end = composite(depth, ray, self.rays)
            return self._color(weight, dynamic.color, ray, end), weight
        static = self.output.depths[1][sample]
        v = self.output.static.blend[sample]
        blend = self.fields.blended(depth, static, v, ray, self.rays, unbounded=False)
        color = self._color(blend.dynamic, dynamic.color, ray, blend.transmittance)
        behind = blend.static[:, None] * self.output.static.color[sample]
        return color + sum_by_ray(behind, ray, self.rays), blend.dynamic

    def _color(self, weight: Tensor, color: Tensor, ray: Tensor, end: Tensor) -> Tensor:
        total = sum_by_ray(weight[:, None] * color, ray, self.rays)
        return total + end[:, None] * self.batch.background

    def trust(self, warp: Warp) -> Tensor:
        """Ŵ_{j→i} (R,): trust in the comparison of each ray's render from another frame.

        1 − Σ sg(w_{j→i}) o_{i→j}, so that the background is trusted; where densities add
        1 − |Σ sg(w_{j→i} − w_i)|. 0 where there is no such frame.
        """
        weight = warp.weight.detach()
        if self.fields.additive:
            own_weight = self.output.blend.dynamic[warp.sample].detach()
            trust = 1 - sum_by_ray(weight - own_weight, warp.ray, self.rays).abs()
        else:
            trust = 1 - sum_by_ray(weight * warp.occlusion, warp.ray, self.rays)
        return trust.clamp(min=0) * warp.exists
