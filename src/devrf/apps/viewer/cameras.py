"""Cameras of the browser, and the captured ones in the page's scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from kornia.geometry.conversions import (
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)
from torch import Tensor

from devrf.apps.images import evenly, scaled, to_bytes
from devrf.evaluation.held_out import truth_image
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import Scene, Views

if TYPE_CHECKING:
    import viser

# From OpenGL's camera axes (y up, z backwards) to OpenCV's (y down, z forwards), and back.
FLIP = (1.0, -1.0, -1.0)
# Rows of an image in a frustum, and the most frusta of a capture.
ROWS, MAX_FRUSTA = 96, 60
# A frustum's depth as a share of the cameras' extent.
DEPTH = 0.04
COLOR = (40, 110, 170)


@dataclass(frozen=True)
class Pose:
    """A camera of the browser.

    Attributes:
        wxyz: the unit quaternion of camera to world, OpenCV axes (x right, y down, z forwards).
        position: (x, y, z) in world units.
        fov: the vertical angle of view in radians.
        aspect: width over height.
    """

    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov: float
    aspect: float

    @staticmethod
    def of(camera_to_world: Tensor, fov: float, aspect: float) -> Pose:
        """The pose of a camera (3, 4) with OpenGL axes; ``fov`` in radians."""
        pose = camera_to_world.double().cpu()
        turned = pose[:, :3] * pose.new_tensor(FLIP)
        w, x, y, z = rotation_matrix_to_quaternion(turned[None])[0].tolist()
        px, py, pz = pose[:, 3].tolist()
        return Pose((w, x, y, z), (px, py, pz), fov, aspect)

    @staticmethod
    def of_browser(camera: viser.CameraHandle) -> Pose:
        """The pose that a page is looked at from."""
        w, x, y, z = map(float, camera.wxyz)
        px, py, pz = map(float, camera.position)
        return Pose((w, x, y, z), (px, py, pz), camera.fov, camera.aspect)

    @staticmethod
    def of_cameras(cameras: Cameras, index: int) -> Pose:
        """The pose of one of N cameras, whose pixels need not be square."""
        fx, fy = cameras.focal[index].tolist()
        aspect = (cameras.width / fx) / (cameras.height / fy)
        return Pose.of(
            cameras.camera_to_world[index], 2 * math.atan(cameras.height / 2 / fy), aspect
        )

    @property
    def camera_to_world(self) -> Tensor:
        """(3, 4) float64, OpenGL axes."""
        turned = quaternion_to_rotation_matrix(torch.tensor([self.wxyz], dtype=torch.float64))[0]
        position = turned.new_tensor(self.position)
        return torch.cat([turned * turned.new_tensor(FLIP), position[:, None]], dim=1)

    def camera(self, height: int) -> Cameras:
        """One camera, with images ``height`` pixels high."""
        width = max(1, round(self.aspect * height))
        focal = height / 2 / math.tan(self.fov / 2)
        return Cameras(
            self.camera_to_world.float()[None],
            torch.tensor([[focal, focal]]),
            torch.tensor([[width / 2, height / 2]]),
            width,
            height,
        )


class Frustum(NamedTuple):
    """A captured camera.

    Attributes:
        name: tells it from others; the same for a fixed camera at every time.
        pose: where it is.
        image: (H', W', 3) uint8, what it took; None where no image was read.
    """

    name: str
    pose: Pose
    image: Tensor | None


def dynamic_frusta(scene: Scene, time: float) -> list[Frustum]:
    """The cameras that saw the scene move, at one of their images' times."""
    views = scene.dynamic.train
    images = ((views.times - time).abs() < scene.clock.TOLERANCE).nonzero()[:, 0].tolist()
    chosen = [images[k] for k in evenly(len(images), MAX_FRUSTA)]
    return [
        Frustum(
            f"moving/{int(views.view[k])}",
            Pose.of_cameras(views.cameras, k),
            _thumbnail(scene, views, k),
        )
        for k in chosen
    ]


def static_frusta(cameras: Cameras, scene: Scene | None) -> list[Frustum]:
    """The cameras that saw the scene at rest, with images if there is a scene."""
    return [
        Frustum(
            f"static/{k}",
            Pose.of_cameras(cameras, k),
            None if scene is None else _thumbnail(scene, scene.static.train, k),
        )
        for k in evenly(len(cameras), MAX_FRUSTA)
    ]


def _thumbnail(scene: Scene, views: Views, index: int) -> Tensor:
    image = truth_image(views, index, scene.background)
    return to_bytes(scaled(image, min(views.height, ROWS)))


class FrustaLayer:
    """The captured cameras in the page's scene."""

    def __init__(self, server: viser.ViserServer, cameras: Cameras, scene: Scene | None) -> None:
        """Show none yet.

        Args:
            server: of the page.
            cameras: that saw the scene at rest.
            scene: with their images; None where they cannot be read.
        """
        self._server, self._cameras, self._scene = server, cameras, scene
        extent = float((cameras.positions.amax(dim=0) - cameras.positions.amin(dim=0)).norm())
        self._depth = DEPTH * (extent or 1.0)
        self._handles: dict[str, viser.CameraFrustumHandle] = {}
        self._shown: object = None

    def show(self, dynamic: bool, static: bool, time: float) -> None:
        """Show the cameras of the chosen captures, with their images of the nearest time."""
        nearest = None
        if dynamic and self._scene is not None:
            times = self._scene.dynamic.train.times
            nearest = float(times[int((times - time).abs().argmin())])
        if (static, nearest) == self._shown:
            return
        self._shown = static, nearest
        frusta = static_frusta(self._cameras, self._scene) if static else []
        if nearest is not None and self._scene is not None:
            frusta += dynamic_frusta(self._scene, nearest)
        for name in set(self._handles) - {frustum.name for frustum in frusta}:
            self._handles.pop(name).remove()
        for frustum in frusta:
            if frustum.name not in self._handles:
                self._handles[frustum.name] = self._added(frustum)
            elif frustum.image is not None:
                self._handles[frustum.name].image = frustum.image.numpy()

    def _added(self, frustum: Frustum) -> viser.CameraFrustumHandle:
        return self._server.scene.add_camera_frustum(
            f"/cameras/{frustum.name}",
            frustum.pose.fov,
            frustum.pose.aspect,
            scale=self._depth,
            thickness=0.02 * self._depth,
            color=COLOR,
            image=None if frustum.image is None else frustum.image.numpy(),
            wxyz=frustum.pose.wxyz,
            position=frustum.pose.position,
        )
