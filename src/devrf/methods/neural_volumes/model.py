"""Neural Volumes (Lombardi et al., SIGGRAPH 2019): images of a moment → a code → a volume."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD
from devrf.methods.base import RayTrainable
from devrf.methods.nerf.occupancy import OccupancyFrames
from devrf.methods.nerf.ray_view import RayView
from devrf.methods.nerf.samples import RaySamples
from devrf.methods.neural_volumes.capture import check_scene, encoder_images
from devrf.methods.neural_volumes.networks import AffineWarp, ConvWarp, TimeEncoder, VolumeDecoder
from devrf.methods.neural_volumes.settings import NeuralVolumesSettings
from devrf.methods.neural_volumes.volumes import (
    Volumes,
    code_divergence,
    log_total_variation,
    opacity_prior,
    seen,
)
from devrf.rendering.output import RenderOutput
from devrf.scenes.scene import Scene

# Moments of a published batch; frames encoded at once.
MOMENTS = 16


class NeuralVolumes(RayTrainable):
    """z from the images of a moment; a template and a warp from z, seen by adding up opacity."""

    name: ClassVar[str] = "neural_volumes"
    losses: ClassVar[tuple[str, ...]] = ("color", "kl", "opacity_prior", "tv")
    protocols: ClassVar[tuple[str, ...] | None] = ("joint", "dynamic")
    codes: Tensor
    images: Tensor

    def __init__(self, settings: NeuralVolumesSettings | None = None) -> None:
        """Build the networks.

        Args:
            settings: sizes and sampling.
        """
        super().__init__()
        self.settings = s = settings or NeuralVolumesSettings()
        self.encoder = TimeEncoder(
            s.encoder_views, s.encoder_size, s.encoder_channels, s.encoder_width, s.code
        )
        self.template = VolumeDecoder(s.code, s.template_channels, 4)
        # Whatever the scale, the cube begins as translucent as published: softplus(0) = ln 2.
        with torch.no_grad():
            assert self.template.output.bias is not None
            self.template.output.bias[3] = math.log(math.expm1(math.log(2) / s.density_scale))
        self.warp: ConvWarp | AffineWarp = (
            ConvWarp(s.code, s.warp_channels, s.warp_scale)
            if s.warp == "conv"
            else AffineWarp(s.code, s.warp_side, s.maps)
        )
        self.occupancy = OccupancyFrames(1, (2, 2, 2))
        self.register_buffer("images", torch.zeros(0, dtype=torch.uint8), persistent=False)
        self.register_buffer("codes", torch.zeros(1, s.code))
        self.register_state_dict_pre_hook(_keep_codes)  # type: ignore[no-untyped-call]
        self.space = WORLD
        self._place(Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), (0.0, 1.0), (0.0,))

    def _place(self, box: Box, limits: tuple[float, float], times: tuple[float, ...]) -> None:
        self.box, self.depth_limits, self.clock = box, limits, FrameClock(times)
        self.codes = self.codes.new_zeros(len(times), self.settings.code)

    def setup(self, scene: Scene) -> None:
        """Take the cube from the scene's bounds, and the images that are encoded.

        Raises:
            DevrfError: the scene is no object in a known box before a known background, or too few
                cameras see all of it.
        """
        check_scene(scene)
        bounds, s = scene.bounds, self.settings
        box = bounds.motion or bounds.box.scaled(bounds.scale)
        self._place(box, (bounds.near, bounds.far), scene.clock.times)
        self.images = encoder_images(scene, s).to(self.device)
        if s.hull:
            self.occupancy = OccupancyFrames.of(
                scene, box, s.occupancy_side, self.device, hull=True
            )

    @property
    def has_hull(self) -> bool:
        """Whether the occupancy was carved from alpha masks."""
        return self.occupancy.has_hull

    def config(self) -> dict[str, Any]:
        """Settings, and where and when the scene is."""
        return {
            "settings": asdict(self.settings),
            "box": [list(self.box.low), list(self.box.high)],
            "limits": list(self.depth_limits),
            "times": list(self.clock.times),
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> NeuralVolumes:
        """Networks of the same sizes in the same place; without images, codes stand in for them."""
        model = cls(NeuralVolumesSettings(**config["settings"]))
        near, far = config["limits"]
        model._place(Box.of(*config["box"]), (near, far), tuple(config["times"]))
        return model

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """Encoder, template and warp."""
        return {
            "encoder": self.encoder.parameters(),
            "template": self.template.parameters(),
            "warp": self.warp.parameters(),
        }

    def forward(self, batch: RayBatch) -> RenderOutput:
        """Render rays; each moment among them is encoded and decoded once."""
        frames, moment = torch.unique(batch.frame, return_inverse=True)
        mean, log_deviation = self.encoded(frames)
        code = mean
        if self.training:
            code = mean + log_deviation.exp() * torch.randn_like(mean)
        volumes = self.decoded(code)
        pair = (batch.frame, batch.frame)
        output = self.render(
            batch.rays, volumes, moment, pair, batch.background, jitter=self.training
        )
        extras = {"mean": mean, "log_deviation": log_deviation, "voxels": volumes.template[:, 3]}
        return RenderOutput(
            color=output.color,
            depth=output.depth,
            transmittance=output.transmittance,
            extras=extras,
        )

    def encoded(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """μ and log s, (M, code) each, of ``frames`` (M,), from their images."""
        images = self.images.index_select(0, frames).float() / 255
        mean, log_deviation = self.encoder(images)
        return mean, log_deviation

    def decoded(self, code: Tensor) -> Volumes:
        """The volumes of codes (M, code)."""
        found = self.template(code)
        color, opacity = found[:, :3].sigmoid(), nn.functional.softplus(found[:, 3:])
        template = torch.cat([color, self.settings.density_scale * opacity], dim=1)
        return Volumes(template, self.warp(code))

    def render(
        self,
        rays: Rays,
        volumes: Volumes,
        moment: Tensor,
        frames: tuple[Tensor, Tensor],
        background: Tensor,
        *,
        jitter: bool = False,
    ) -> RenderOutput:
        """What R rays see.

        Args:
            rays: R rays in world space.
            volumes: of M moments.
            moment: (R,) int64, the moment of each ray.
            frames: (R,) int64 twice, the frames before and after each ray's time.
            background: (3,) or (R, 3) RGB.
            jitter: sample at random places, to learn from them.
        """
        if len(self.occupancy.mask) == 1:  # one mask for all frames, which excludes nothing
            frames = (torch.zeros_like(moment), torch.zeros_like(moment))
        half = self.box.longest / 2
        step = self.settings.step * half
        found = self.occupancy.march(rays, frames, self.box, self.depth_limits, step, jitter=jitter)
        low, high = self.box.corners(found.points)
        points = (2 * found.points - low - high) / (high - low)
        samples = RaySamples(found.ray, found.distance, found.length / half, points, found.rays)
        values = volumes.at(points, moment.index_select(0, samples.ray))
        return seen(samples, values, background)

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``color``, and the priors of codes, rays and voxels (losses.py)."""
        terms = super().loss_terms(output, batch, names) if "color" in names else {}
        if "kl" in names:
            terms["kl"] = code_divergence(output.extras["mean"], output.extras["log_deviation"])
        if "opacity_prior" in names:
            terms["opacity_prior"] = opacity_prior(1 - output.transmittance)
        if "tv" in names:
            terms["tv"] = log_total_variation(output.extras["voxels"])
        return terms

    @torch.no_grad()
    def code_at(self, time: float) -> Tensor:
        """μ (1, code) at ``time``; between two frames their blend."""
        moment = self.clock.at(time)
        pair = torch.tensor([moment.before, moment.after], device=self.device)
        mean = self.encoded(pair)[0] if len(self.images) else self.codes[pair]
        return torch.lerp(mean[:1], mean[1:], moment.weight)

    @torch.no_grad()
    def at(self, time: float, *, half: bool = False) -> RayView:
        """The scene at ``time``; its volume is decoded here, once for all pictures."""
        moment = self.clock.at(time)
        decoded = Decoded(self, self.decoded(self.code_at(time)), (moment.before, moment.after))
        return RayView(decoded, time, self.device, at_rest=moment.after == 0, half=half)


class Decoded:
    """Neural Volumes at one time, decoded."""

    def __init__(self, model: NeuralVolumes, volumes: Volumes, frames: tuple[int, int]) -> None:
        """Keep the volume and the frames around its time."""
        self._model, self._volumes, self._frames = model, volumes, frames

    def render_rays(self, rays: Rays, time: Tensor, background: Tensor) -> RenderOutput:
        """What rays see at that time."""
        moment = torch.zeros_like(time, dtype=torch.long)
        before, after = (torch.full_like(moment, frame) for frame in self._frames)
        return self._model.render(rays, self._volumes, moment, (before, after), background)


@torch.no_grad()
def _keep_codes(model: nn.Module, prefix: str, keep_vars: bool) -> None:
    """Write each frame's μ into the state, so that it can be rendered without the images."""
    assert isinstance(model, NeuralVolumes)
    if len(model.images):
        frames = torch.arange(len(model.images), device=model.images.device)
        means = [model.encoded(part)[0] for part in torch.split(frames, MOMENTS)]
        model.codes.copy_(torch.cat(means))
