"""D-NeRF (Pumarola et al., CVPR 2021): a radiance field at rest, and an MLP that leads to it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space
from devrf.geometry.space_config import space_config, space_from
from devrf.methods.base import DynamicModel
from devrf.methods.dnerf.deformation import TranslationField
from devrf.methods.nerf.hierarchical import flattened, importance, limits, stratified
from devrf.methods.nerf.occupancy_frames import OccupancyFrames
from devrf.methods.nerf.radiance_field import RadianceField
from devrf.methods.nerf.ray_samples import RaySamples, volume_render
from devrf.methods.nerf.ray_view import RayView
from devrf.ops.compositing import composite
from devrf.rendering.output import RenderOutput
from devrf.scenes.scene import Scene


@dataclass(frozen=True)
class DNeRFSettings:
    """Sizes and sampling; the defaults are the published ones (docs/methods/dnerf.md).

    Attributes:
        width: units of each layer of the radiance field.
        depth: layers of the radiance field.
        bands: octaves of positions.
        direction_bands: octaves of viewing directions.
        deformation_width: units of each layer of the deformation.
        deformation_depth: layers of the deformation.
        time_bands: octaves of times: 4 in the paper, 10 in the released code.
        density_scale: density of a softplus of 1, per half of the box's longest edge.
        sampling: ``hierarchical`` (coarse, then fine by weight) or ``occupancy`` (even steps where
            something may be, told by the visual hull of each frame's mattes where there are any).
        coarse: samples a ray before weights are known (hierarchical).
        fine: samples a ray that are drawn by weight (hierarchical).
        steps: samples along the box's diagonal (occupancy).
        occupancy_side: the masks have about side³ cells (occupancy).
    """

    width: int = 256
    depth: int = 8
    bands: int = 10
    direction_bands: int = 4
    deformation_width: int = 256
    deformation_depth: int = 8
    time_bands: int = 4
    density_scale: float = 10.0
    sampling: Literal["hierarchical", "occupancy"] = "hierarchical"
    coarse: int = 64
    fine: int = 128
    steps: int = 128
    occupancy_side: int = 48

    def __post_init__(self) -> None:
        for name in ("width", "depth", "coarse", "fine", "steps", "occupancy_side"):
            if getattr(self, name) < 2:
                raise DevrfError(
                    f"ray_stage.model.settings.{name}: expected at least 2, not "
                    f"{getattr(self, name)}"
                )


class DNeRF(DynamicModel):
    """(σ, c) = T(x + Δ(x, t), d), with Δ = 0 at t = 0."""

    name: ClassVar[str] = "dnerf"
    losses: ClassVar[tuple[str, ...]] = ("color", "temporal")

    def __init__(self, settings: DNeRFSettings | None = None) -> None:
        """Build the networks.

        Args:
            settings: sizes and sampling.
        """
        super().__init__()
        self.settings = settings or DNeRFSettings()
        s = self.settings
        self.canonical = RadianceField(
            s.width, s.depth, s.bands, s.direction_bands, s.density_scale
        )
        self.deformation = TranslationField(
            s.deformation_width, s.deformation_depth, s.bands, s.time_bands
        )
        self.occupancy = OccupancyFrames(1, (2, 2, 2))
        self._place(Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), WORLD, (0.0, 1.0), (0.0, 1.0))

    def _place(
        self, box: Box, space: Space, limits: tuple[float, float], times: tuple[float, ...]
    ) -> None:
        self.box, self.space, self.depth_limits = box, space, limits
        self.clock = FrameClock(times)

    def setup(self, scene: Scene) -> None:
        """Take the scene's bounds and times; carve the frames' occupancy from their mattes."""
        bounds, s = scene.bounds, self.settings
        box = bounds.box if bounds.motion is None else bounds.box.union(bounds.motion)
        self._place(box, scene.space, (bounds.near, bounds.far), scene.clock.times)
        if s.sampling == "occupancy":
            shape = box.grid_shape(s.occupancy_side**3)
            self.occupancy = OccupancyFrames(len(scene.clock), shape).to(self.device)
            if scene.kind == "inward" and scene.space.straight:
                self.occupancy.carve(scene, box)

    def config(self) -> dict[str, Any]:
        """Settings, and where and when the scene is."""
        return {
            "settings": asdict(self.settings),
            "box": [list(self.box.low), list(self.box.high)],
            "space": space_config(self.space),
            "limits": list(self.depth_limits),
            "times": list(self.clock.times),
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> DNeRF:
        """Networks of the same sizes in the same place."""
        model = cls(DNeRFSettings(**config["settings"]))
        low, high = config["box"]
        near, far = config["limits"]
        model._place(
            Box.of(low, high), space_from(config["space"]), (near, far), tuple(config["times"])
        )
        return model

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The radiance field and the deformation."""
        return {
            "canonical": self.canonical.parameters(),
            "deformation": self.deformation.parameters(),
        }

    def forward(self, batch: RayBatch) -> RenderOutput:
        """Render rays, each at its own time."""
        return self.render_rays(batch.rays, batch.time, batch.background, jitter=self.training)

    def render_rays(
        self, rays: Rays, time: Tensor, background: Tensor, *, jitter: bool = False
    ) -> RenderOutput:
        """What R rays in the fields' space see at ``time`` (R,).

        Args:
            rays: R rays.
            time: (R,) in [0, 1].
            background: (3,) or (R, 3) RGB.
            jitter: sample at random places, to learn from them.
        """
        samples = self._samples(rays, time, jitter=jitter)
        if not self.space.straight:
            samples = samples.endless()
        points, when = self._normalised(samples.points), time.index_select(0, samples.ray)
        canonical = points + self.deformation(points, when)
        density, color = self.canonical(canonical, rays.viewdirs, samples.ray)
        seen = volume_render(self._scaled(samples), density, color, background)
        return RenderOutput(
            color=seen.color,
            depth=seen.depth,
            transmittance=seen.transmittance,
            extras={**seen.extras, "points": points, "time": when},
        )

    def _samples(self, rays: Rays, time: Tensor, *, jitter: bool) -> RaySamples:
        if self.settings.sampling == "occupancy":
            return self._march(rays, time, jitter=jitter)
        s = self.settings
        near, far = limits(rays, self.box, self.depth_limits)
        distance = stratified(near, far, s.coarse, jitter=jitter)
        with torch.no_grad():
            coarse = flattened(rays, distance, far)
            points, when = self._normalised(coarse.points), time.index_select(0, coarse.ray)
            density = self.canonical.sigma(points + self.deformation(points, when))
            depth = density * self._scaled(coarse).length
            weight, _ = composite(depth, coarse.ray, len(rays))
            drawn = importance(distance, weight.view_as(distance), near, far, s.fine, jitter=jitter)
            distance, _ = torch.cat([distance, drawn], dim=1).sort(dim=1)
        return flattened(rays, distance, far)

    def _march(self, rays: Rays, time: Tensor, *, jitter: bool) -> RaySamples:
        """Even steps where something may be at the frames around each ray's time."""
        times = torch.tensor(self.clock.times, device=time.device)
        after = torch.searchsorted(times, time.contiguous() - FrameClock.TOLERANCE)
        after = after.clamp(max=len(times) - 1)
        on_frame = (times[after] - time).abs() <= FrameClock.TOLERANCE
        before = torch.where(on_frame, after, (after - 1).clamp(min=0))
        diagonal = sum(edge**2 for edge in self.box.size) ** 0.5
        unit = float(rays.directions.norm(dim=1).amax()) if len(rays) else 1.0
        return self.occupancy.march(
            rays,
            (before, after),
            self.box,
            self.depth_limits,
            diagonal / (self.settings.steps * unit),
            jitter=jitter,
        )

    @property
    def _half_edge(self) -> float:
        return self.box.longest / 2

    def _normalised(self, points: Tensor) -> Tensor:
        """Points (S, 3) of the fields' space, the box's longest edge being 2."""
        return (points - points.new_tensor(self.box.middle)) / self._half_edge

    def _scaled(self, samples: RaySamples) -> RaySamples:
        """The same samples, their lengths in normalised units."""
        length = samples.length / self._half_edge
        return RaySamples(samples.ray, samples.distance, length, samples.points, samples.rays)

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``color``; ``temporal``: Σ |Δ(x, t) − Δ(x, t′)|², t′ towards a neighbouring frame."""
        terms = super().loss_terms(output, batch, names) if "color" in names else {}
        if "temporal" in names:
            points, time = output.extras["points"].detach(), output.extras["time"]
            between = 1 / max(len(self.clock) - 1, 1)
            other = (time + between * (2 * torch.rand_like(time) - 1)).clamp(0, 1)
            change = self.deformation(points, time) - self.deformation(points, other)
            terms["temporal"] = change.square().sum()
        return terms

    def at(self, time: float, *, half: bool = False) -> RayView:
        """The scene at ``time``."""
        at_rest = self.clock.at(time).after == 0
        return RayView(self, time, self.device, at_rest=at_rest, half=half)
