"""A moving shape filmed: posed images at rest and in motion, with exact depth and flow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.scenes.procedural.march import CHUNK, MAX_STEPS, block_starts, trace
from devrf.scenes.procedural.shading import shaded
from devrf.scenes.procedural.shape import Shape
from devrf.scenes.procedural.truth import backward_flow
from devrf.scenes.scene import Capture, OpticalFlow, Views


@dataclass(frozen=True)
class Pictures:
    """N images of a shape at one time.

    Attributes:
        pixels: (N, H, W, 4) uint8 RGBA, alpha not premultiplied; (N, H, W, 3) where opaque.
        depth: (N, H, W) float32 distance along the ray through each pixel's centre, world
            units, +inf where it meets nothing.
    """

    pixels: Tensor
    depth: Tensor


@dataclass(frozen=True)
class Filming:
    """What is filmed, and how.

    Attributes:
        shape: what all cameras see, from outside of it.
        reach: radius of a ball about the origin that holds the shape at all times, world units.
        supersample: n: colour and alpha are the mean of n × n rays a pixel.
        light: share of the lamp in the lighting, 0 (albedo alone) … 1.
        steps: after how many steps a ray counts as a miss.
        opaque: whether every ray meets something, so that the images need no alpha.
    """

    shape: Shape
    reach: float
    supersample: int = 2
    light: float = 0.2
    steps: int = MAX_STEPS
    opaque: bool = False

    def at_rest(self, train: Cameras, test: Cameras) -> Capture:
        """One image from each camera at time 0."""
        return Capture(self._still(train, "train"), self._still(test, "test"))

    def moving(
        self, train: Cameras, test: Cameras, frames: int, unseen: Sequence[int] = ()
    ) -> Capture:
        """All fixed cameras at frame 0, then all at frame 1, …, with the exact backward flow.

        Args:
            train: V cameras to learn from.
            test: held-out cameras.
            frames: number of frames T ≥ 2, at times k / (T − 1).
            unseen: frames that the cameras to learn from leave out.
        """
        every = range(frames)
        seen = [frame for frame in every if frame not in unseen]
        return Capture(
            self._moving(train, seen, frames, "train"), self._moving(test, every, frames, "test")
        )

    def _still(self, cameras: Cameras, split: str) -> Views:
        pictures = self.pictures(cameras, 0.0)
        return Views(
            pixels=pictures.pixels,
            cameras=cameras,
            times=torch.zeros(len(cameras)),
            view=torch.arange(len(cameras)),
            names=tuple(f"static {split} {k:03d}" for k in range(len(cameras))),
            depth=pictures.depth,
        )

    def _moving(self, cameras: Cameras, shown: Sequence[int], frames: int, split: str) -> Views:
        times = torch.tensor(shown) / (frames - 1)
        clock: list[float] = times.tolist()
        pictures = [self.pictures(cameras, time) for time in clock]
        nowhere = torch.zeros_like(pictures[0].depth)
        flows = [OpticalFlow(torch.stack([nowhere, nowhere], dim=-1), nowhere.bool())]
        for earlier, time, picture in zip(clock, clock[1:], pictures[1:], strict=False):
            flows.append(backward_flow(self.shape, cameras, picture.depth, time, earlier))
        view = torch.arange(len(cameras)).repeat(len(shown))
        frame = torch.arange(len(shown)).repeat_interleave(len(cameras))
        return Views(
            pixels=torch.cat([p.pixels for p in pictures]),
            cameras=cameras[view],
            times=times[frame],
            view=view,
            names=tuple(
                f"dynamic {split} frame {shown[k]:03d} view {v}"
                for k, v in zip(frame.tolist(), view.tolist(), strict=True)
            ),
            flow=OpticalFlow(
                torch.cat([f.vectors for f in flows]), torch.cat([f.valid for f in flows])
            ),
            depth=torch.cat([p.depth for p in pictures]),
        )

    def pictures(self, cameras: Cameras, time: float) -> Pictures:
        """One image from each of N ``cameras`` at ``time``."""
        start = block_starts(self.shape, cameras, time, self.reach)
        size = start.shape
        start = start.reshape(-1)
        depth, image = torch.full_like(start, torch.inf), start.new_zeros(len(start), 4)
        grid = cameras.pixel_grid()
        # From a pixel's centre to the centres of its n × n parts.
        steps = (torch.arange(self.supersample) + 0.5) / self.supersample - 0.5
        offsets = torch.cartesian_prod(steps, steps)
        count = len(offsets)
        live = start.isfinite().nonzero().squeeze(-1)
        for pixel in torch.split(live, max(CHUNK // count, 1)):
            camera, center, onset = pixel // len(grid), grid[pixel % len(grid)], start[pixel]
            depth[pixel] = self._trace(cameras.rays(camera, center), time, onset)
            parts = (center[:, None] + offsets).reshape(-1, 2)
            rays = cameras.rays(camera.repeat_interleave(count), parts)
            distance = self._trace(rays, time, onset.repeat_interleave(count))
            hit = distance.isfinite().nonzero().squeeze(-1)
            # Colour times alpha, and alpha: only these may be averaged.
            samples = start.new_zeros(len(rays), 4)
            samples[hit, 3] = 1
            samples[hit, :3] = shaded(self.shape, rays.at(hit, distance[hit]), time, self.light)
            mean = samples.view(-1, count, 4).mean(dim=1)
            color = mean[:, :3] / mean[:, 3:].clamp_min(1e-6)
            image[pixel] = torch.cat([color, mean[:, 3:]], dim=-1)
        pixels = (image * 255).round().clamp(0, 255).to(torch.uint8).view(*size, 4)
        if self.opaque:
            pixels = pixels[..., :3].contiguous()
        return Pictures(pixels, depth.view(size))

    def _trace(self, rays: Rays, time: float, start: Tensor) -> Tensor:
        return trace(self.shape, rays, time, start, self.reach, self.steps)
