"""A scene at one moment: all that films, stills, evaluation and the viewer ask of a method."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.geometry.space import Space
from devrf.rendering.rendered_image import RenderedImage


class View(Protocol):
    """A scene at one time, ready to be looked at from anywhere.

    Attributes:
        chunk: rays that are best rendered at once on the scene's device.
        at_rest: whether it shows what the scene shows at time 0.
    """

    @property
    def chunk(self) -> int:
        """Rays that are best rendered at once."""
        ...

    @property
    def at_rest(self) -> bool:
        """Whether this is the rest state."""
        ...

    def render(self, rays: Rays, background: Tensor) -> RenderedImage:
        """What R rays see, without gradients.

        Args:
            rays: R rays in the space of the scene's fields, on its device.
            background: (3,) RGB behind everything.
        """
        ...


@runtime_checkable
class MovingView(View, Protocol):
    """A view that knows where what it shows was at another time."""

    def induced_flow(
        self, rays: Rays, pixels: Tensor, cameras: Cameras, time: float
    ) -> tuple[Tensor, Tensor]:
        """How what R rays see moved in the image between ``time`` and the view's own time.

        Args:
            rays: R rays in the space of the scene's fields.
            pixels: (R, 2) x, y of the rays in the image, in pixels.
            cameras: one camera, at ``time``.
            time: in [0, 1].

        Returns:
            (R, 2) the mean over each ray of (pixel at ``time``) − (pixel now), weighted by the
            rendering weights; and (R,) the sum of these weights.
        """
        ...


class Viewable(Protocol):
    """A scene that can be looked at: a :class:`~devrf.methods.base.DynamicModel`."""

    @property
    def box(self) -> Box:
        """What holds the scene, in the space of its fields."""
        ...

    @property
    def space(self) -> Space:
        """The space that its fields live in."""
        ...

    @property
    def depth_limits(self) -> tuple[float, float]:
        """Distances before and behind which nothing is sampled, in the space of the fields."""
        ...

    @property
    def device(self) -> torch.device:
        """Where it is."""
        ...

    def at(self, time: float, *, half: bool = False) -> View:
        """The scene at ``time`` in [0, 1].

        Args:
            time: in [0, 1].
            half: let networks work in half precision where device and method can.
        """
        ...
