"""Where a forward-facing scene is: the box in normalised device coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.scene import Bounds, Views
from devrf.scenes.validation import scene_error

# Cosine of the steepest angle, about 84 degrees, to −z: beyond it the box grows without bound.
LEAST_COSINE = 0.1
# How many times as wide as the reference camera's view the box may be: beyond it the other
# cameras are not before the same scene, and a float32 cannot tell its points apart.
WIDEST = 1e3


def reference_space(cameras: Cameras, near: float) -> NormalizedDevice:
    """NDC of a camera at the origin with the mean focal lengths of ``cameras``.

    Args:
        cameras: the static cameras, whose average pose is the identity.
        near: distance of the near plane, world units.
    """
    fx, fy = cameras.focal.double().mean(dim=0).tolist()
    return NormalizedDevice(cameras.width, cameras.height, (fx, fy), near)


def forward_bounds(everyone: list[Views], space: NormalizedDevice, source: str) -> Bounds:
    """The box that holds all that cameras see from the near plane to infinity, in NDC.

    Rays are straight in NDC too, so it is enough to follow the rays through the images'
    corners: ``origin`` on the near plane (z' = −1), ``origin + direction`` at infinity (z' = 1).
    Hence near = 0 and far = 1, in multiples of an NDC ray's direction.

    Args:
        everyone: the views whose cameras count.
        space: the scene's NDC.
        source: where the room for motion comes from, for the log.

    Raises:
        DevrfError: a camera sees something that is not before the reference camera.
    """
    return Bounds(
        box_between(everyone, space), near=0.0, far=1.0, motion=None, scale=1.0, source=source
    )


def box_between(
    everyone: list[Views], space: NormalizedDevice, front: float = -1.0, back: float = 1.0
) -> Box:
    """The box, in NDC, of what cameras see from one depth to another.

    Args:
        everyone: the views whose cameras count.
        space: the scene's NDC.
        front: z' of the nearest points, −1 at the near plane.
        back: z' of the furthest points, 1 at infinity.

    Raises:
        DevrfError: a camera sees something that is not before the reference camera.
    """
    ends = torch.cat([_seen(views, space, (front, back)) for views in everyone])
    low, high = ends.amin(dim=0).tolist(), ends.amax(dim=0).tolist()
    return Box.of([low[0], low[1], front], [high[0], high[1], back])


def _seen(views: Views, space: NormalizedDevice, depths: tuple[float, float]) -> Tensor:
    """NDC (8 · N, 3) of the rays through the corners of N images at two ``depths`` z'."""
    cameras = views.cameras
    edge = [(0, 0), (cameras.width, 0), (0, cameras.height), (cameras.width, cameras.height)]
    corners = torch.tensor(edge, dtype=cameras.focal.dtype).repeat(len(cameras), 1)
    image = torch.arange(len(cameras)).repeat_interleave(len(edge))
    rays = cameras.rays(image, corners)
    steep = (-rays.directions[:, 2] < LEAST_COSINE).nonzero().flatten()
    if len(steep):
        raise scene_error(
            views.names[int(image[steep[0]])],
            "its camera does not look along the common viewing "
            "direction, so normalised device coordinates cannot hold what it sees; leave the "
            "image out, or use data=inward for cameras around a scene",
        )
    device = space.rays(rays)
    ends = torch.stack([device.origins, device.origins + device.directions])
    # NaN compares false.
    away = (~(ends.abs() <= WIDEST).all(dim=-1).all(dim=0)).nonzero().flatten()
    if len(away):
        raise scene_error(
            views.names[int(image[away[0]])],
            "its camera is too far from the others for "
            "normalised device coordinates to hold what it sees; correct its position, or leave "
            "the image out",
        )
    return torch.cat([device.origins + (z + 1) / 2 * device.directions for z in depths])
