"""Camera paths of videos."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from devrf.apps.film import FilmSettings
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Views

# The cameras of a film of some settings, around a scene or before it.
Ring = Callable[[FilmSettings], Cameras]
# Cameras and as many times in [0, 1].
Shots = tuple[Cameras, list[float]]


def orbit(cameras: Cameras, box: Box, settings: FilmSettings) -> Cameras:
    """Cameras on a circle around a box, looking at its middle.

    Args:
        cameras: the captured cameras: the orbit has their mean distance, focal length and up.
        box: what to look at.
        settings: number of frames, elevation, turns.
    """
    middle = torch.tensor(box.middle)
    radius = float((cameras.positions - middle).norm(dim=1).mean())
    up = normalize(cameras.camera_to_world[:, :, 1].mean(dim=0), dim=0)
    away = torch.eye(3)[int(up.abs().argmin())]
    east = normalize(torch.linalg.cross(away, up), dim=0)
    axes = torch.stack([east, torch.linalg.cross(up, east)])
    height = math.radians(settings.orbit_elevation)
    center = middle + radius * math.sin(height) * up
    return _ring(cameras, center, radius * math.cos(height) * axes, middle, up, settings)


def spiral(cameras: Cameras, focus: float, settings: FilmSettings) -> Cameras:
    """Cameras on a small ring before a forward-facing scene, looking at one point in it.

    Args:
        cameras: the captured cameras: the ring lies among them and has their focal length.
        focus: distance of the point they look at, world units.
        settings: number of frames, turns.
    """
    pose = cameras.camera_to_world.mean(dim=0)
    right, up, back = normalize(pose[:, :3], dim=0).unbind(dim=1)
    axes, middle = torch.stack([right, up]), pose[:, 3]
    offsets = (cameras.positions - middle) @ axes.T
    radii = 0.9 * offsets.abs().quantile(0.8, dim=0)
    return _ring(cameras, middle, radii[:, None] * axes, middle - focus * back, up, settings)


def bullet_time(ring: Ring, moment: float, settings: FilmSettings) -> Shots:
    """Once around the scene while its time stands still at ``moment``."""
    return ring(settings), [moment] * settings.frames


def time_freeze(ring: Ring, moment: float, settings: FilmSettings) -> Shots:
    """Time runs to ``moment`` and stands still while the camera goes round; then it runs on.

    Each takes a third of the frames.
    """
    before = after = settings.frames // 3
    around = settings.frames - before - after
    cameras = ring(replace(settings, frames=around))
    index = [0] * before + list(range(around)) + [0] * after
    times = [
        *torch.linspace(0, moment, before + 1)[:-1].tolist(),
        *[moment] * around,
        *torch.linspace(moment, 1, after).tolist(),
    ]
    return cameras[index], times


def held_out_images(views: Views, frames: int) -> list[int]:
    """The held-out image for each of ``frames`` times, evenly spread over [0, 1].

    Of a capture with fixed cameras these are images of the first one. Images at rest follow one
    another.

    Args:
        views: held-out views, at least one.
        frames: number of times.
    """
    first = (views.view == views.view[0]).nonzero()[:, 0]
    own = first if len(first) > 1 else torch.arange(len(views))
    times = views.times[own]
    if bool((times == times[0]).all()):
        times = torch.linspace(0, 1, len(own))
    wanted = torch.linspace(0, 1, frames)
    nearest = (times[None] - wanted[:, None]).abs().argmin(dim=1)
    found: list[int] = own[nearest].tolist()
    return found


def _ring(
    cameras: Cameras,
    center: Tensor,
    axes: Tensor,
    target: Tensor,
    up: Tensor,
    settings: FilmSettings,
) -> Cameras:
    """Cameras on the ellipse about ``center`` with the half axes (2, 3), looking at ``target``."""
    angle = torch.arange(settings.frames) * (2 * math.pi * settings.orbit_turns / settings.frames)
    positions = center + torch.stack([angle.cos(), angle.sin()], dim=1) @ axes
    return Cameras.looking_at(
        positions,
        target.expand_as(positions),
        focal=float(cameras.focal.mean()),
        width=cameras.width,
        height=cameras.height,
        up=up,
    )


def focus_distance(renderer: Renderer, cameras: Cameras) -> float:
    """Median depth along the optical axis, world units, of what the first camera sees at rest."""
    cameras, space = cameras.to(renderer.device), renderer.model.space
    rays = cameras.image_rays(0)
    image = renderer.picture(rays, 0.0, 1.0)
    solid = (image.opacity > 0.5).nonzero()[:, 0]
    if len(solid) == 0:
        return float(cameras.positions.norm(dim=1).mean()) + 1.0
    points = space.to_world(space.rays(rays).at(solid, image.depth[solid]))
    _, depth = cameras.project_into(0, points)
    return float(depth.median())
