"""Where the camera of a video goes."""

from __future__ import annotations

import math

import torch

from devrf.artifacts.film import FilmSettings
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer


def orbit(cameras: Cameras, box: Box, settings: FilmSettings) -> Cameras:
    """Cameras on a circle around a box, looking at its middle.

    Args:
        cameras: the captured cameras: the orbit has their mean distance, their lens, and the
            direction that is up for them.
        box: what to look at.
        settings: how many, how high, how often round.
    """
    middle = torch.tensor(box.middle)
    radius = float((cameras.positions - middle).norm(dim=1).mean())
    up = torch.nn.functional.normalize(cameras.camera_to_world[:, :, 1].mean(dim=0), dim=0)
    away = torch.eye(3)[int(up.abs().argmin())]
    east = torch.nn.functional.normalize(torch.linalg.cross(away, up), dim=0)
    north = torch.linalg.cross(up, east)
    angle = torch.arange(settings.frames) * (2 * math.pi * settings.orbit_turns / settings.frames)
    height = math.radians(settings.orbit_elevation)
    ring = angle.cos()[:, None] * east + angle.sin()[:, None] * north
    positions = middle + radius * (math.cos(height) * ring + math.sin(height) * up)
    return Cameras.looking_at(
        positions,
        middle.expand_as(positions),
        focal=float(cameras.focal.mean()),
        width=cameras.width,
        height=cameras.height,
        up=up,
    )


def spiral(cameras: Cameras, focus: float, settings: FilmSettings) -> Cameras:
    """Cameras on a small ring before a forward-facing scene, looking at one point in it.

    Args:
        cameras: the captured cameras: the ring lies among them and has their lens.
        focus: distance of the point they look at, world units.
        settings: how many, how often round.
    """
    pose = cameras.camera_to_world.mean(dim=0)
    right, up, back = torch.nn.functional.normalize(pose[:, :3], dim=0).unbind(dim=1)
    middle = pose[:, 3]
    offsets = (cameras.positions - middle) @ torch.stack([right, up], dim=1)
    across, along = (offsets.abs().quantile(0.8, dim=0) * 0.9).tolist()
    turn = torch.arange(settings.frames) * (2 * math.pi * settings.orbit_turns / settings.frames)
    positions = middle + across * turn.cos()[:, None] * right + along * turn.sin()[:, None] * up
    return Cameras.looking_at(
        positions,
        (middle - focus * back).expand_as(positions),
        focal=float(cameras.focal.mean()),
        width=cameras.width,
        height=cameras.height,
        up=up,
    )


def focus_distance(player: Renderer, cameras: Cameras) -> float:
    """Median depth along the optical axis, world units, of what the first camera sees at rest."""
    cameras, space = cameras.to(player.device), player.model.space
    rays = cameras.image_rays(0)
    seen = player.picture(rays, 0.0, 1.0)
    solid = (seen.opacity > 0.5).nonzero()[:, 0]
    if len(solid) == 0:
        return float(cameras.positions.norm(dim=1).mean()) + 1.0
    points = space.to_world(space.rays(rays).at(solid, seen.depth[solid]))
    _, depth = cameras.project_into(0, points)
    return float(depth.median())
