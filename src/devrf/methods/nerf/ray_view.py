"""A scene of any method that renders rays at their own times, seen at one time."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.rendering.output import RenderedImage, RenderOutput

# Rays at once, on a CPU and on a GPU.
ON_CPU, ON_GPU = 2048, 2**14


class RendersRays(Protocol):
    """A method whose rays bring their own times."""

    def render_rays(self, rays: Rays, time: Tensor, background: Tensor) -> RenderOutput:
        """What rays see, each at its ``time`` (R,)."""
        ...


class RayView:
    """A method at one time.

    Attributes:
        at_rest: whether the time shows the rest state.
        chunk: rays that are best rendered at once.
    """

    def __init__(
        self, model: RendersRays, time: float, device: torch.device, *, at_rest: bool, half: bool
    ) -> None:
        """Keep what there is to know.

        Args:
            model: renders.
            time: in [0, 1].
            device: where the model is.
            at_rest: whether the time shows the rest state.
            half: networks in half precision, on a CUDA device.
        """
        self._model, self._time = model, time
        self._half = half and device.type == "cuda"
        self.at_rest = at_rest
        self.chunk = ON_GPU if device.type == "cuda" else ON_CPU

    @torch.no_grad()
    def render(self, rays: Rays, background: Tensor) -> RenderedImage:
        """What R rays in the fields' space see."""
        time = torch.full_like(rays.origins[:, 0], self._time)
        with torch.autocast(time.device.type, torch.float16, enabled=self._half):
            seen = self._model.render_rays(rays, time, background)
        return RenderedImage(seen.color.float(), seen.depth.float(), 1 - seen.transmittance.float())
