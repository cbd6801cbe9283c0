"""A method as videos, pictures, evaluation, the viewer and exports see it."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.rendering.output import RenderedImage


class View(Protocol):
    """A scene at one time, ready to be rendered along any rays."""

    @property
    def chunk(self) -> int:
        """The number of rays to render at once on the scene's device."""

    @property
    def at_rest(self) -> bool:
        """Whether the scene is in its canonical state, as at time 0."""

    def render(self, rays: Rays, background: Tensor) -> RenderedImage:
        """Render R rays in the fields' space without gradients, before a background (3,) RGB."""


@runtime_checkable
class ImageView(Protocol):
    """A scene at one time, ready to be rendered as whole images, of a method without rays."""

    @property
    def at_rest(self) -> bool:
        """Whether the scene is in its canonical state, as at time 0."""

    def image(self, camera: Cameras, background: Tensor, crop: Box | None) -> RenderedImage:
        """Render all H·W pixels of one camera, in row-major order, without gradients.

        Args:
            camera: one camera, world units.
            background: (3,) RGB.
            crop: only the part of the scene in this box is rendered; None: all of it.
        """


@runtime_checkable
class MovingView(View, Protocol):
    """A view that knows the motion of its points between two times."""

    def induced_flow(
        self, rays: Rays, pixels: Tensor, cameras: Cameras, time: float
    ) -> tuple[Tensor, Tensor]:
        """Optical flow of R rays between ``time`` and the view's own time.

        Args:
            rays: R rays in the space of the scene's fields.
            pixels: (R, 2) x, y of the rays in the image, in pixels.
            cameras: one camera, at ``time``.
            time: in [0, 1].

        Returns:
            (R, 2) the mean over each ray of (pixel at ``time``) − (pixel now), weighted by the
            rendering weights; and (R,) the sum of these weights.
        """


class SurfaceField(Protocol):
    """Density and colour as functions of canonical points in the fields' space."""

    @property
    def box(self) -> Box:
        """The box of the canonical scene, in the fields' space."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Points along x, y, z of a grid over the box that is as fine as the field."""

    def optical_depth(self, points: Tensor) -> Tensor:
        """τ (M,) of a way of one voxel at ``points`` (M, 3), so that its opacity is 1 − exp(−τ).

        0 where nothing is rendered.
        """

    def color(self, points: Tensor, viewdirs: Tensor) -> Tensor:
        """RGB (M, 3) in [0, 1], as in the images, at ``points`` (M, 3).

        ``viewdirs`` (M, 3) are unit directions in world space, from the eye to the points.
        """
