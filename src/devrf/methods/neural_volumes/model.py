"""Neural Volumes (Lombardi et al., SIGGRAPH 2019): images of a moment → a code → a volume."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.geometry.rays import Rays
from devrf.methods.nerf.occupancy import OccupancyFrames
from devrf.methods.nerf.placed_model import PlacedRays, RayView
from devrf.methods.nerf.samples import accumulated
from devrf.methods.neural_volumes.capture import check_scene, encoder_images
from devrf.methods.neural_volumes.networks import (
    AffineMixWarp,
    ConvWarp,
    TimeEncoder,
    VolumeDecoder,
)
from devrf.methods.neural_volumes.settings import NeuralVolumesSettings
from devrf.methods.neural_volumes.volumes import (
    Volumes,
    added_opacity,
    code_divergence,
    log_total_variation,
    opacity_prior,
)
from devrf.rendering.output import RenderOutput
from devrf.scenes.scene import Scene

# The number of frames in a published batch, and of frames that are encoded at once.
MOMENTS = 16


class NeuralVolumes(PlacedRays):
    """z from the images of a moment; a template and a warp from z, seen by adding up opacity."""

    name: ClassVar[str] = "neural_volumes"
    losses: ClassVar[tuple[str, ...]] = ("render", "kl", "opacity_prior", "tv")
    keeps_batches: ClassVar[bool] = True  # a volume takes most of an iteration
    protocols: ClassVar[tuple[str, ...] | None] = ("joint", "dynamic")
    settings_class = NeuralVolumesSettings
    settings: NeuralVolumesSettings
    codes: Tensor
    images: Tensor

    def __init__(self, settings: NeuralVolumesSettings | None = None) -> None:
        """Build the networks, as published if no settings are given."""
        s = settings or NeuralVolumesSettings()
        super().__init__(s)
        self.encoder = TimeEncoder(s)
        self.template = VolumeDecoder(s.code, s.template_channels, 4)
        # Whatever the scale, the cube begins as translucent as published: softplus(0) = ln 2.
        with torch.no_grad():
            assert self.template.output.bias is not None
            self.template.output.bias[3] = math.log(math.expm1(math.log(2) / s.density_scale))
        self.warp = ConvWarp(s) if s.warp == "conv" else AffineMixWarp(s)
        self.register_buffer("images", torch.zeros(0, dtype=torch.uint8), persistent=False)
        self.register_buffer("codes", torch.zeros(1, s.code))
        self.register_state_dict_pre_hook(_keep_codes)  # type: ignore[no-untyped-call]
        self.place()

    def set_times(self, times: tuple[float, ...]) -> None:
        """Take the frames' times; a checkpoint has a code of each."""
        super().set_times(times)
        self.codes = self.codes.new_zeros(len(times), self.settings.code)

    def setup(self, scene: Scene) -> None:
        """Take the cube from the scene's bounds, and the images that are encoded.

        Raises:
            DevrfError: the scene is no object in a known box before a known background, or too few
                cameras see all of it.
        """
        check_scene(scene)
        bounds = scene.bounds
        s = self.settings
        box = bounds.motion or bounds.box.scaled(bounds.scale)
        self.set_place(box, scene.space, (bounds.near, bounds.far))
        self.set_times(scene.clock.times)
        self.images = encoder_images(scene, s).to(self.device)
        if s.hull:
            occupancy = OccupancyFrames.of(scene, box, s.occupancy_side, hull=True)
            self.occupancy = occupancy.to(self.device)

    @property
    def sample_outputs(self) -> int:
        """A place in the warp, one in the template, colour, opacity and weights: no layers."""
        return 3 + 3 + 4 + 4

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
        jitter = self.training
        pair = (batch.frame, batch.frame)
        code = mean + log_deviation.exp() * torch.randn_like(mean) if jitter else mean
        volumes = self.decoded(code)
        output = self.render(batch.rays, volumes, moment, pair, batch.background, jitter=jitter)
        extras = {"mean": mean, "log_deviation": log_deviation, "voxels": volumes.template[:, 3]}
        return replace(output, extras=extras)

    def encoded(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """μ and log s, (M, code) each, of ``frames`` (M,), from their images."""
        images = self.images.index_select(0, frames).float() / 255
        mean, log_deviation = self.encoder(images)
        return mean, log_deviation

    def decoded(self, code: Tensor) -> Volumes:
        """The volumes of codes (M, code)."""
        channels = self.template(code)
        color = channels[:, :3].sigmoid()
        opacity = nn.functional.softplus(channels[:, 3:])
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
        """The render of R rays: C = Σ w_i c_i + (1 − A) · background.

        Args:
            rays: R rays in world space.
            volumes: of M moments.
            moment: (R,) int64, the moment of each ray.
            frames: (R,) int64 twice, the frames before and after each ray's time.
            background: (3,) or (R, 3) RGB.
            jitter: sample at random positions, to learn from them.
        """
        if len(self.occupancy.mask) == 1:  # one mask for all frames, which excludes nothing
            frames = (torch.zeros_like(moment), torch.zeros_like(moment))
        half = self.box.longest / 2
        step = self.settings.step * half
        depths = self.depth_limits
        samples = self.occupancy.march(rays, frames, self.box, depths, step, jitter=jitter)
        low, high = self.box.corners(samples.points)
        points = (2 * samples.points - low - high) / (high - low)
        values = volumes.at(points, moment.index_select(0, samples.ray))
        amount = values[:, 3] * (samples.length / half)
        weight, opacity = added_opacity(amount, samples.ray, samples.rays)
        color = weight[:, None] * values[:, :3]
        return accumulated(samples, weight, color, 1 - opacity, background)

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``render``, and the priors of codes, rays and voxels (``volumes.py``)."""
        terms = super().loss_terms(output, batch, names) if "render" in names else {}
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
    def at(self, time: float) -> RayView:
        """The scene at ``time``; its volume is decoded here, once for all pictures."""
        moment = self.clock.at(time)
        volumes = self.decoded(self.code_at(time))

        def render_rays(rays: Rays, times: Tensor, background: Tensor) -> RenderOutput:
            first = torch.zeros_like(times, dtype=torch.long)
            frames = (first + moment.before, first + moment.after)
            return self.render(rays, volumes, first, frames, background)

        return RayView(self, render_rays, time)


@torch.no_grad()
def _keep_codes(model: nn.Module, prefix: str, keep_vars: bool) -> None:
    """Write each frame's μ into the state, so that it can be rendered without the images."""
    assert isinstance(model, NeuralVolumes)
    if len(model.images):
        frames = torch.arange(len(model.images), device=model.images.device)
        means = [model.encoded(part)[0] for part in torch.split(frames, MOMENTS)]
        model.codes.copy_(torch.cat(means))
