"""A moving shape filmed: posed images at rest and in motion, with exact depth and flow."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from devrf.geometry.cameras import Cameras
from devrf.scenes.procedural.march import MAX_STEPS
from devrf.scenes.procedural.picture import Pictures, render
from devrf.scenes.procedural.shape import Shape
from devrf.scenes.procedural.truth import backward_flow
from devrf.scenes.scene import OpticalFlow, Views


@dataclass(frozen=True)
class Filming:
    """What is filmed, and how.

    Attributes:
        shape: what all cameras see.
        reach: radius of a ball about the origin that holds the shape at all times, world units.
        supersample: n × n rays a pixel.
        light: share of the lamp in the lighting, 0 … 1.
        steps: after how many steps a ray counts as a miss.
    """

    shape: Shape
    reach: float
    supersample: int
    light: float
    steps: int = MAX_STEPS

    def at_rest(self, cameras: Cameras, split: str) -> Views:
        """One image from each of N ``cameras`` at time 0; ``split`` goes into their names."""
        pictures = self.pictures(cameras, 0.0)
        return Views(
            pixels=pictures.pixels,
            cameras=cameras,
            times=torch.zeros(len(cameras)),
            view=torch.arange(len(cameras)),
            names=tuple(f"static {split} {k:03d}" for k in range(len(cameras))),
            depth=pictures.depth,
        )

    def moving(self, cameras: Cameras, frames: int, split: str) -> Views:
        """All cameras at frame 0, then all at frame 1, …, with the exact backward flow.

        Args:
            cameras: V fixed cameras.
            frames: number of frames T ≥ 2, at times k / (T − 1).
            split: goes into the images' names.
        """
        times = torch.arange(frames) / (frames - 1)
        clock: list[float] = times.tolist()
        pictures = [self.pictures(cameras, time) for time in clock]
        nowhere = torch.zeros_like(pictures[0].depth)
        flows = [OpticalFlow(torch.stack([nowhere, nowhere], dim=-1), nowhere.bool())]
        for earlier, time, picture in zip(clock, clock[1:], pictures[1:], strict=False):
            flows.append(backward_flow(self.shape, cameras, picture.depth, time, earlier))
        view = torch.arange(len(cameras)).repeat(frames)
        frame = torch.arange(frames).repeat_interleave(len(cameras))
        return Views(
            pixels=torch.cat([p.pixels for p in pictures]),
            cameras=cameras[view],
            times=times[frame],
            view=view,
            names=tuple(
                f"dynamic {split} frame {k:03d} view {v}"
                for k, v in zip(frame.tolist(), view.tolist(), strict=True)
            ),
            flow=OpticalFlow(
                torch.cat([f.vectors for f in flows]), torch.cat([f.valid for f in flows])
            ),
            depth=torch.cat([p.depth for p in pictures]),
        )

    def pictures(self, cameras: Cameras, time: float) -> Pictures:
        """One image from each of N ``cameras`` at ``time``."""
        return render(
            self.shape,
            cameras,
            time,
            reach=self.reach,
            supersample=self.supersample,
            light=self.light,
            steps=self.steps,
        )
