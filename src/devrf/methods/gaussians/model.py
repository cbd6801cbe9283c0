"""Deformable 3D Gaussians (Yang et al., CVPR 2024): a cloud, and a network that moves it."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize
from warp import Kernel

from devrf.data.batch import ImageBatch
from devrf.engine.needs import tensor_bytes
from devrf.engine.protocol import ProtocolStage
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.motion import moving
from devrf.kernels.ahead import splatting_kernels
from devrf.kernels.splatting import splat
from devrf.methods.base import ImageTrainable
from devrf.methods.gaussians.cloud import NEIGHBOURS, Cloud, first_points
from devrf.methods.gaussians.settings import GaussiansSettings
from devrf.methods.nerf.networks import SinusoidalEncoding, Trunk
from devrf.methods.nerf.placed_model import PlacedModel
from devrf.metrics.image import ssim_map
from devrf.ops.compositing import LEAST_MASS
from devrf.ops.spherical_harmonics import spherical_harmonics
from devrf.ops.splatting import LOW_PASS, Gaussians
from devrf.rendering.output import RenderedImage, RenderOutput
from devrf.rendering.renderable import Renderable
from devrf.scenes.scene import Scene
from devrf.system.options import Positive

# Normalised places are at most this: in NDC those that come to lie before the near plane would be
# infinite.
OUTERMOST = 8.0
# Half of the longest edge, in world units, of the box of the robot, on which rates were chosen.
USUAL_UNIT = 1.15
# Standard deviation of the weights of the network's last layer at first: nothing moves.
STILL = 1e-3


class DeformableGaussians(PlacedModel[ImageBatch], ImageTrainable):
    """Gaussians at rest, of which a network tells how each has moved at a time.

    See docs/methods/gaussians.md.

    Attributes:
        cloud: the Gaussians at rest, in world units whatever the fields' space is.
        placement: of what held them at first; the network is told places in its normalised space.
        near: the least depth of a Gaussian's mean in a picture, world units.
        extent: the unit of lengths in the settings, world units.
        focal: the longest focal length in pixels that was learned from.
        degree: of the harmonics that are used now.
        moves_now: whether the network is asked.
        moves_at_rest: whether it is asked at time 0, too, when the cloud has no images of its own.
    """

    name: ClassVar[str] = "gaussians"
    losses: ClassVar[tuple[str, ...]] = ("l1", "ssim", "embedding")
    random_background: ClassVar[bool] = True
    unbuilt: ClassVar[tuple[str, ...]] = ("start_points", "max_points")
    settings_class = GaussiansSettings
    checkpointed_attributes: ClassVar[Mapping[str, Any]] = {
        "near": Positive,
        "extent": Positive,
        "focal": Positive,
        "moves_at_rest": bool,
    }
    settings: GaussiansSettings

    def __init__(self, settings: GaussiansSettings | None = None) -> None:
        """Build the network, and a cloud of one; of published sizes if no settings are given."""
        s = settings or GaussiansSettings()
        super().__init__(s)
        self.cloud = Cloud(s.harmonics, s.embedding)
        self.encode = SinusoidalEncoding(3, s.bands, first=math.pi)
        self.encode_time = SinusoidalEncoding(1, s.time_bands, first=math.pi)
        inputs = self.encode.size + s.embedding + self.encode_time.size
        self.trunk = Trunk(inputs, s.width, s.depth, skip=4)
        self.last = nn.Linear(s.width, 10)
        nn.init.normal_(self.last.weight, std=STILL)
        nn.init.zeros_(self.last.bias)
        self.near, self.extent, self.focal = 0.1, 1.0, 1.0
        self.degree = s.harmonics
        self.moves_now = True
        self.moves_at_rest = False
        self.place()

    def setup(self, scene: Scene) -> None:
        """Take bounds and times; begin the cloud."""
        bounds = scene.bounds
        self.set_place(bounds.whole, scene.space, (bounds.near, bounds.far))
        self.set_times(scene.clock.times)
        at_rest = scene.static.train.cameras.positions
        extent = 1.1 * float((at_rest - at_rest.mean(dim=0)).norm(dim=1).max())
        captures = [capture.train.cameras for capture in scene.captures.values()]
        everyone = torch.cat([cameras.positions for cameras in captures])
        self.near = self.placement.near(bounds.near, everyone)
        self.extent = max(extent, self.placement.unit)
        self.focal = max(float(cameras.focal.max()) for cameras in captures)
        self.cloud.begin(*first_points(scene, self.settings), self.settings.start_opacity)

    def moved(self, time: float) -> tuple[Tensor, Tensor, Tensor] | None:
        """δ of means (N, 3), quaternions (N, 4) and logarithms of scales (N, 3); None at rest.

        They grow from 0 at time 0 to the network's at the first frame after it, unless it moves the
        cloud at all times.
        """
        moment = self.clock.at(time)
        begun = 1.0 if self.moves_at_rest or moment.before else moment.weight
        if begun == 0 or not self.moves_now:
            return None
        means = self.cloud.means.detach()
        place = self.placement.normalised(self.space.from_world(means))
        place = place.nan_to_num(0.0).clamp(-OUTERMOST, OUTERMOST)
        encoded = self.encode_time(means.new_full((1, 1), time)).expand(len(means), -1)
        inputs = [self.encode(place), self.cloud.embedding, encoded]
        values = self.trunk(torch.cat(inputs, dim=1))
        mean, quaternion, scale = (begun * self.last(values)).split([3, 4, 3], dim=1)
        return self.placement.unit / USUAL_UNIT * mean, quaternion, scale

    def gaussians(self, time: float, eye: Tensor) -> Gaussians:
        """The cloud at a time, as it looks from a point (3,)."""
        moves = self.moved(time)
        count = (self.degree + 1) ** 2
        basis = self.cloud.means.new_ones(len(self.cloud), 1)
        if count > 1:
            means = self.cloud.means if moves is None else self.cloud.means + moves[0]
            basis = spherical_harmonics(normalize(means.detach() - eye, dim=1))[:, :count]
        return self.cloud.gaussians(moves, basis)

    @torch.no_grad()
    def gaussians_at(self, time: float) -> Gaussians:
        """The cloud at a time, its colours those of the harmonic of degree 0."""
        basis = self.cloud.means.new_ones(len(self.cloud), 1)
        gaussians = self.cloud.gaussians(self.moved(time), basis)
        return replace(gaussians, means=gaussians.means.detach())

    def moving_and_still(self, size: float) -> dict[str, Renderable]:
        """The scene with some of its Gaussians alone; the network is shared."""
        moves = moving((self.gaussians_at(time).means for time in self.clock.times), size)
        apart = bool(moves.any()) and not bool(moves.all())
        parts: dict[str, Renderable] = {}
        for name, rows in (("moving", moves), ("still", ~moves)) if apart else ():
            part = copy.deepcopy(self, {id(module): module for module in (self.trunk, self.last)})
            part.cloud.keep(rows)
            parts[name] = part
        return parts

    def forward(self, batch: ImageBatch) -> RenderOutput:
        """Render an image; while the cloud learns, note where it lacks detail."""
        camera = batch.camera
        gaussians = self.gaussians(batch.time, camera.positions[0])
        shift = None
        if self.cloud.means.requires_grad and torch.is_grad_enabled():
            shift = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
            half = shift.new_tensor([camera.width / 2, camera.height / 2])
            shift.register_hook(  # type: ignore[no-untyped-call]
                lambda slopes: self.cloud.note(slopes * half)
            )
        image = splat(gaussians, camera, self.near, shift)
        color = image.color + image.transmittance[:, None] * batch.background
        depth = image.depth / (1 - image.transmittance).clamp(min=LEAST_MASS)
        return RenderOutput(color=color, depth=depth, transmittance=image.transmittance)

    def loss_terms(
        self, output: RenderOutput, batch: ImageBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``l1``, the mean absolute error; ``ssim``, 1 − SSIM; ``embedding`` of neighbours."""
        truth = batch.color
        if batch.valid is not None:
            truth = torch.where(batch.valid[:, None], truth, output.color)
        terms = {"l1": (output.color - truth).abs().mean()}
        if "ssim" in names:
            shape = (batch.camera.height, batch.camera.width, 3)
            terms["ssim"] = 1 - ssim_map(output.color.view(shape), truth.view(shape)).mean()
        if "embedding" in names:
            # |z_i − z_j|², j one of the nearest of each Gaussian i (Bae et al. 2024): of all six it
            # takes a seventh of an iteration.
            apart: Tensor = self.cloud.embedding
            if apart.numel():
                other = self.cloud.neighbours[:, int(torch.randint(NEIGHBOURS, ()))]
                apart = apart - apart[other]
            terms["embedding"] = apart.square().sum() / len(apart)
        return {name: term for name, term in terms.items() if name in names}

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The cloud; the network that moves it, and what it is told of each Gaussian."""
        network = [*self.trunk.parameters(), *self.last.parameters()]
        cloud = [getattr(self.cloud, name) for name in Cloud.at_rest]
        return {"canonical": cloud, "deformation": network, "embedding": [self.cloud.embedding]}

    def param_groups(self) -> list[dict[str, Any]]:
        """A group for each part of the cloud at rest; the network; what it is told of each."""
        s = self.settings
        rates = {name: getattr(s, f"{name}_rate") for name in Cloud.at_rest}
        rates["means"] *= self.extent
        groups: list[dict[str, Any]] = []
        for group in super().param_groups():
            if group["name"] != "canonical":
                groups.append(group)
                continue
            for name, rate in rates.items():
                decay = 1.0 if s.all_decay else s.means_decay if name == "means" else 0.0
                own = {"name": name, "params": [getattr(self.cloud, name)]}
                groups.append({**own, "rate": rate, "decay": decay})
        return groups

    def begin_stage(self, stage: ProtocolStage) -> None:
        """Freeze parts; a cloud that learns begins to count its growths."""
        super().begin_stage(stage)
        self.moves_at_rest = stage.capture == "dynamic" and stage.builds_on is None
        self.cloud.grown.zero_()

    def growths(self, total: int) -> Sequence[int]:
        """As the settings say, if the cloud learns."""
        s = self.settings
        if not self.cloud.means.requires_grad:
            return ()
        count = math.floor((s.densify_until - s.densify_from) / s.densify_every + 1e-6) + 1
        return [round((s.densify_from + k * s.densify_every) * total) for k in range(count)]

    def grow(self, count: int) -> Mapping[str, Tensor] | None:
        """Prune, clone and split, once for each count."""
        s = self.settings
        if count <= int(self.cloud.grown):
            return None
        every = round(s.reset_every / s.densify_every)
        return self.cloud.grow(s, self.extent, reset=every > 0 and count % every == 0)

    def milestones(self, total: int) -> dict[str, int]:
        """The iteration from which something moves, where the cloud learns, too."""
        still = round(self.settings.still * total)
        return {"motion begun": still} if still and self.cloud.means.requires_grad else {}

    def on_iteration(self, step: int, total: int) -> None:
        """Let the cloud move, and let harmonics of one more degree count, in time."""
        s = self.settings
        if not self.cloud.means.requires_grad:
            return
        self.moves_now = step >= s.still * total
        if s.harmonics_every:
            self.degree = min(s.harmonics, int(step / (s.harmonics_every * total)))

    @property
    def most_bytes(self) -> int:
        """Of as many Gaussians as there may be."""
        of_one = tensor_bytes(self.cloud.parameters()) // len(self.cloud)
        return super().most_bytes + of_one * self.settings.max_points

    @property
    def kernels(self) -> Sequence[Kernel]:
        """Those of splatting."""
        return splatting_kernels()

    def at(self, time: float) -> GaussiansView:
        """The scene at ``time``."""
        return GaussiansView(self, time)


@dataclass(frozen=True)
class GaussiansView:
    """Gaussians at one time."""

    model: DeformableGaussians
    time: float

    @property
    def at_rest(self) -> bool:
        """Whether it is time 0."""
        return self.model.clock.at(self.time).after == 0

    @torch.no_grad()
    def image(self, camera: Cameras, background: Tensor, crop: Box | None) -> RenderedImage:
        """The picture; of a longer lens than was learned from, Gaussians are no thinner there."""
        model = self.model
        gaussians = model.gaussians(self.time, camera.positions[0])
        if crop is not None:
            keep = crop.contains(model.space.from_world(gaussians.means))
            gaussians = Gaussians(*(value[keep] for value in vars(gaussians).values()))
        focal = float(camera.focal.max())
        if focal > model.focal:
            # What LOW_PASS was in the pictures that were learned from, and is not here.
            depth = (gaussians.means - camera.positions[0]) @ camera.forwards[0]
            hidden = LOW_PASS * (1 / model.focal**2 - 1 / focal**2)
            wide = gaussians.scales.square() + hidden * depth.square()[:, None]
            gaussians = replace(gaussians, scales=wide.sqrt())
        image = splat(gaussians, camera, model.near)
        opacity = 1 - image.transmittance
        color = image.color + image.transmittance[:, None] * background
        rays = camera.image_rays(0)
        ahead = rays.directions @ camera.forwards[0]  # cosine of a ray and the camera's axis
        distance = image.depth / (ahead * opacity.clamp(min=LEAST_MASS))
        depth = model.space.depths(rays, distance)
        return RenderedImage(color, depth.where(opacity > 0, 0.0), opacity)
