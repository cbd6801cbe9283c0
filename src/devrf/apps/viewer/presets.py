"""Paths that the page knows: an orbit while time runs, bullet time, and a freeze in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from devrf.apps.camera_paths import bullet_time, orbit, spiral, time_freeze
from devrf.apps.film import FilmSettings
from devrf.apps.keyframes import Keyframe, keyframes_of
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.rendering.view import Viewable

# Keyframes of a path, and the seconds that it takes to go round.
KEYFRAMES, SECONDS = 13, 8.0
# From a time in [0, 1], at which the film is to stop.
Preset = Callable[[float], tuple[Keyframe, ...]]


def known_paths(cameras: Cameras, model: Callable[[], Viewable]) -> dict[str, Preset]:
    """Paths by name: around a scene, or before a forward-facing one.

    Args:
        cameras: the static captured ones.
        model: gives the scene, once there is one.
    """
    settings = FilmSettings(frames=KEYFRAMES)

    def ring(film: FilmSettings) -> Cameras:
        """Comes back to where it began."""
        space, film = model().space, replace(film, frames=film.frames - 1)
        again = [*range(film.frames), 0]
        if isinstance(space, NormalizedDevice):
            return spiral(cameras, distance_ahead(cameras), film)[again]
        return orbit(cameras, space.inner(model().box), film)[again]

    def orbiting(moment: float) -> tuple[Keyframe, ...]:
        return keyframes_of(ring(settings), torch.linspace(0, 1, KEYFRAMES).tolist(), SECONDS)

    def bullet(moment: float) -> tuple[Keyframe, ...]:
        return keyframes_of(*bullet_time(ring, moment, settings), SECONDS)

    def freeze(moment: float) -> tuple[Keyframe, ...]:
        longer = FilmSettings(frames=3 * KEYFRAMES)
        return keyframes_of(*time_freeze(ring, moment, longer), 3 * SECONDS)

    return {"orbit": orbiting, "bullet time": bullet, "time freeze": freeze}


def distance_ahead(cameras: Cameras) -> float:
    """How far before N cameras the point is that lies nearest to all their optical axes.

    It solves Σ (1 − d dᵀ)(p − o) = 0 for p. Axes that meet nowhere give the cameras' extent.
    """
    origins, forwards = cameras.positions, cameras.forwards
    across = torch.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    extent = float((origins - origins.mean(dim=0)).norm(dim=1).max()) or 1.0
    normal = across.sum(dim=0)
    if float(torch.linalg.eigvalsh(normal)[0]) < 1e-3 * len(cameras):
        return extent
    point = torch.linalg.solve(normal, (across @ origins[:, :, None]).sum(dim=0)[:, 0])
    distance = float(((point - origins) * forwards).sum(dim=1).mean())
    return distance if distance > 0 else extent
