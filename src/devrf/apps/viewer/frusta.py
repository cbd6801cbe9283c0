"""The captured cameras of a scene, with the pictures that they took at a time."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from devrf.apps.colors import to_bytes
from devrf.apps.grid import scaled
from devrf.apps.images import evenly
from devrf.apps.viewer.poses import Pose
from devrf.evaluation.held_out import truth_image
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import Background, Scene, Views

# Rows of a picture in a frustum, and the most frusta of a capture.
ROWS, MOST = 96, 60
# A frustum's depth as a share of the cameras' extent.
SHARE = 0.04


@dataclass(frozen=True)
class Frustum:
    """A captured camera.

    Attributes:
        name: tells it from others; the same for a fixed camera at every time.
        pose: where it is.
        picture: (H', W', 3) uint8, what it took; None where no image was read.
    """

    name: str
    pose: Pose
    picture: Tensor | None


def moving_frusta(scene: Scene, time: float) -> list[Frustum]:
    """The cameras that saw the scene move, at their images' time that is nearest to ``time``."""
    views = scene.dynamic.train
    nearest = views.times[int((views.times - time).abs().argmin())]
    images = ((views.times - nearest).abs() < scene.clock.TOLERANCE).nonzero()[:, 0].tolist()
    return [
        _frustum(views, k, f"moving/{int(views.view[k])}", scene.background) for k in _few(images)
    ]


def resting_frusta(scene: Scene) -> list[Frustum]:
    """The cameras that saw the scene at rest."""
    views = scene.static.train
    return [
        _frustum(views, k, f"static/{k}", scene.background) for k in _few(list(range(len(views))))
    ]


def bare_frusta(cameras: Cameras) -> list[Frustum]:
    """Cameras of which no image was read."""
    return [
        Frustum(f"static/{k}", Pose.of_cameras(cameras, k), None)
        for k in _few(list(range(len(cameras))))
    ]


def frustum_scale(cameras: Cameras) -> float:
    """How deep frusta are drawn, in world units."""
    positions = cameras.positions
    extent = float((positions.amax(dim=0) - positions.amin(dim=0)).norm())
    return SHARE * extent if extent > 0 else SHARE


def _few(images: list[int]) -> list[int]:
    return [images[k] for k in evenly(len(images), MOST)]


def _frustum(views: Views, index: int, name: str, background: Background) -> Frustum:
    picture = truth_image(views, index, background)
    if views.height > ROWS:
        picture = scaled(picture, ROWS)
    pose = Pose.of_cameras(views.cameras, index)
    return Frustum(name, pose, to_bytes(picture))
