"""Where the scene at rest has moved, found by Gaussians (docs/method.md#splat-alignment)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.kernels.splatting import splat
from devrf.kernels.trilinear import interpolate
from devrf.methods.devrf.extensions.priors import elastic_energy, occupied_cells
from devrf.methods.devrf.extensions.smooth_change import smooth_change
from devrf.methods.devrf.model import DeVRFModel
from devrf.ops.splatting import Gaussians
from devrf.scenes.scene import Views

# Images are compared at this size at most: pixels of the longer side.
LONGEST = 64
# Voxels of at least this optical depth τ are Gaussians.
OPAQUE = 0.5
# Their standard deviation in voxels, opacity and colour before they are fitted to the images.
SIZE, OPACITY, GREY = 0.3, 0.6, 0.5
# Images at rest that they are fitted to, each so many times, and Adam's rates.
REST_IMAGES, REST_ROUNDS = 8, 8
REST_RATES = {"opacity": 0.1, "scale": 0.05, "color": 0.02}
# Steps of a frame's change, and images that each looks at, in turn; the standard deviation, as a
# share of the longer side, by which residuals are blurred at the first step and at the last; and
# the weights of the terms beside them.
STEPS, AT_ONCE = 80, 2
FIRST_BLUR, LAST_BLUR = 1 / 8, 1 / 64
ELASTIC, SMOOTHNESS = 5e-3, 3.8e-3


@dataclass(frozen=True)
class SmallImage:
    """An image of few pixels.

    Attributes:
        camera: its camera.
        pixels: (4, H, W) RGB · alpha, and alpha.
        valid: (H, W) the share of each pixel that counts.
    """

    camera: Cameras
    pixels: Tensor
    valid: Tensor

    @staticmethod
    def of(views: Views, image: int, device: torch.device) -> SmallImage:
        """An image with alpha of ``views``, reduced to :data:`LONGEST` pixels a side."""
        view = views.single(image).to(device)
        camera = view.cameras
        scale = min(1.0, LONGEST / max(camera.width, camera.height))
        height = max(1, round(scale * camera.height))
        width = max(1, round(scale * camera.width))
        pixels = view.pixels[0].permute(2, 0, 1) / 255
        mask = view.valid_mask
        valid = torch.ones_like(pixels[:1]) if mask is None else mask.to(pixels)
        alpha = valid * pixels[3:]
        channels = torch.cat([alpha * pixels[:3], alpha, valid])
        reduced = adaptive_avg_pool2d(channels, (height, width))
        camera = camera.resized(width, height)
        return SmallImage(camera, pixels=reduced[:4], valid=reduced[4])

    def residual(self, gaussians: Gaussians, near: float) -> Tensor:
        """What ``gaussians`` show too much in each channel (4, H, W)."""
        camera = self.camera
        image = splat(gaussians, camera, near)
        channels = torch.cat([image.color, 1 - image.transmittance[:, None]], dim=1)
        return self.valid * channels.T.view(4, camera.height, camera.width) - self.pixels


class SplatAlignment:
    """Moves the scene at rest, as Gaussians, to where the images of a frame show it.

    What is rendered through a backward warp has a gradient only where something is rendered: a part
    that has moved further than it is thick is not led to its new place. Gaussians that move
    forwards are, if images are compared after both are blurred.

    Attributes:
        points: (N, 3) the means at rest, world units.
    """

    def __init__(self, model: DeVRFModel, at_rest: Views, most: int) -> None:
        """Make Gaussians of the opaque voxels, and fit them to images.

        Args:
            model: its canonical field is in world space.
            at_rest: views of it with alpha masks.
            most: Gaussians, of voxels that are chosen at random.
        """
        self.near = max(model.depth_limits[0], 1e-6)
        surface = model.surface()
        device = model.device
        grid = surface.box.grid_points(surface.shape, torch.empty(0, device=device)).view(-1, 3)
        points = grid[surface.optical_depth(grid) >= OPAQUE]
        chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:most]
        self.points = points[chosen.to(device)]
        count = len(self.points)
        # Of fewer Gaussians each stands for more.
        edge = surface.box.longest / (max(surface.shape) - 1)
        edge *= max(len(points) / max(count, 1), 1.0) ** (1 / 3)
        self._looks = {
            "opacity": torch.full((count,), math.log(OPACITY / (1 - OPACITY)), device=device),
            "scale": torch.full((count,), math.log(SIZE * edge), device=device),
            "color": torch.full((count, 3), GREY, device=device),
        }
        self._fit_to(at_rest)

    @torch.enable_grad()
    def _fit_to(self, at_rest: Views) -> None:
        """Learn opacities, sizes and colours from some images."""
        numbers = torch.linspace(0, len(at_rest) - 1, min(REST_IMAGES, len(at_rest))).round()
        device = self.points.device
        images = [SmallImage.of(at_rest, int(number), device) for number in numbers]
        looks = {name: value.requires_grad_() for name, value in self._looks.items()}
        groups = [{"params": [looks[name]], "lr": rate} for name, rate in REST_RATES.items()]
        optimizer = torch.optim.Adam(groups)
        for _ in range(REST_ROUNDS):
            for image in images:
                optimizer.zero_grad()
                residual = image.residual(self._gaussians(self.points, looks), self.near)
                residual.square().mean().backward()  # type: ignore[no-untyped-call]
                optimizer.step()
        self._looks = {name: value.detach() for name, value in looks.items()}

    def _gaussians(self, means: Tensor, looks: Mapping[str, Tensor]) -> Gaussians:
        """Round Gaussians at ``means`` (N, 3)."""
        turns = means.new_tensor([[1.0, 0.0, 0.0, 0.0]])
        return Gaussians(
            means=means,
            scales=looks["scale"].exp()[:, None].expand(-1, 3),
            quaternions=turns.expand(len(means), 4),
            opacity=looks["opacity"].sigmoid(),
            color=looks["color"],
        )

    def change(
        self, model: DeVRFModel, views: Views, images: Sequence[int], forward: Tensor, box: Box
    ) -> Tensor:
        """What to add to Δ_f so that the scene is where the images show it (X, Y, Z, 3).

        Args:
            model: the scene.
            views: have alpha masks; on the model's device.
            images: those of the frame.
            forward: (X, Y, Z, 3) Δ_f to begin with, world units.
            box: of Δ_f.
        """
        small = [SmallImage.of(views, image, forward.device) for image in images]
        base = self.points + interpolate(forward, self.points, box)
        shape = (forward.shape[0], forward.shape[1], forward.shape[2])
        occupied = occupied_cells(model.occupancy, box, shape)
        side = max(max(image.pixels.shape[1:]) for image in small)
        # As residuals grow with the square of the images' side, so does what stands beside them.
        elastic = ELASTIC * (side / LONGEST) ** 2

        def misfit(change: Tensor, step: int) -> Tensor:
            moved = self._gaussians(base + interpolate(change, self.points, box), self._looks)
            loss = elastic * elastic_energy(forward + change, box, occupied)
            share = step / (STEPS - 1)
            sigma = side * FIRST_BLUR ** (1 - share) * LAST_BLUR**share
            radius = math.ceil(2.5 * sigma)
            for number in range(step * AT_ONCE, (step + 1) * AT_ONCE):
                image = small[number % len(small)]
                blurred = gaussian_blur2d(
                    image.residual(moved, self.near)[None],
                    kernel_size=2 * radius + 1,
                    sigma=(sigma, sigma),
                    border_type="constant",
                )
                # As many pixels of a blurred image show a mass as σ² says.
                loss = loss + sigma**2 * blurred.square().mean() / AT_ONCE
            return loss

        # Pixels to a unit of length.
        middle = torch.tensor(box.middle)
        scale = 1 / max(image.camera.pixel_size(middle) for image in small)
        return smooth_change(misfit, like=forward, scale=scale, steps=STEPS, smoothness=SMOOTHNESS)
