"""Cameras of the browser, and the captured ones in the page's scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from kornia.geometry.conversions import (
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)
from torch import Tensor

from devrf.geometry.cameras import Cameras

if TYPE_CHECKING:
    from viser import CameraHandle
import threading

import viser

from devrf.apps.images import evenly, scaled, to_bytes
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.evaluation.held_out import truth_image
from devrf.scenes.scene import Background, Scene, Views

# From OpenGL's camera axes (y up, z backwards) to OpenCV's (y down, z forwards), and back.
FLIP = (1.0, -1.0, -1.0)


@dataclass(frozen=True)
class Pose:
    """A camera of the browser.

    Attributes:
        wxyz: the unit quaternion of camera to world, OpenCV axes (x right, y down, z forwards).
        position: (x, y, z) in world units.
        fov: the vertical angle of view in radians.
        aspect: width over height.
    """

    wxyz: tuple[float, ...]
    position: tuple[float, ...]
    fov: float
    aspect: float

    @staticmethod
    def of(camera_to_world: Tensor, fov: float, aspect: float) -> Pose:
        """The pose of a camera (3, 4) with OpenGL axes; ``fov`` in radians."""
        pose = camera_to_world.double().cpu()
        turned = pose[:, :3] * pose.new_tensor(FLIP)
        wxyz = rotation_matrix_to_quaternion(turned[None])[0]
        return Pose(tuple(wxyz.tolist()), tuple(pose[:, 3].tolist()), fov, aspect)

    @staticmethod
    def of_browser(camera: CameraHandle) -> Pose:
        """The pose that a page is looked at from."""
        return Pose(tuple(camera.wxyz), tuple(camera.position), camera.fov, camera.aspect)

    @staticmethod
    def of_cameras(cameras: Cameras, index: int) -> Pose:
        """The pose of one of N cameras."""
        fov = 2 * math.atan(cameras.height / 2 / float(cameras.focal[index, 1]))
        # Its pixels need not be square.
        wide = 2 * math.atan(cameras.width / 2 / float(cameras.focal[index, 0]))
        return Pose.of(cameras.camera_to_world[index], fov, math.tan(wide / 2) / math.tan(fov / 2))

    @property
    def camera_to_world(self) -> Tensor:
        """(3, 4) float64, OpenGL axes."""
        turned = quaternion_to_rotation_matrix(_row(self.wxyz))[0]
        rotation = turned * turned.new_tensor(FLIP)
        return torch.cat([rotation, _row(self.position).T], dim=1)

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


def _row(numbers: Sequence[float]) -> Tensor:
    return torch.tensor([[float(one) for one in numbers]], dtype=torch.float64)


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


COLOR = (40, 110, 170)


class FrustaLayer:
    """Frusta in the scene, of which only those that changed are sent to the browser."""

    def __init__(
        self, server: viser.ViserServer, viewpoints: Viewpoints, scene: Scene | None
    ) -> None:
        """Show none yet.

        Args:
            server: of the page.
            viewpoints: the captured cameras.
            scene: with their images; None where they cannot be read.
        """
        self._server, self._scene, self._static = server, scene, viewpoints.static
        self._scale = frustum_scale(viewpoints.static)
        self._shown: dict[str, viser.CameraFrustumHandle] = {}
        self._pictures: dict[str, Tensor | None] = {}
        self._last: object = None
        self._lock = threading.Lock()

    def show(self, moving: bool, resting: bool, time: float) -> None:
        """Show the cameras of the chosen captures, with their pictures at ``time``."""
        wanted = (moving, resting, time if moving else 0.0)
        with self._lock:
            if wanted != self._last:
                self._last = wanted
                self._put(self._chosen(moving, resting, time))

    def _chosen(self, moving: bool, resting: bool, time: float) -> list[Frustum]:
        scene = self._scene
        at_rest: list[Frustum] = []
        if resting:
            at_rest = bare_frusta(self._static) if scene is None else resting_frusta(scene)
        return at_rest + (moving_frusta(scene, time) if moving and scene is not None else [])

    def _put(self, frusta: list[Frustum]) -> None:
        names = {one.name for one in frusta}
        for name in set(self._shown) - names:
            self._shown.pop(name).remove()
            del self._pictures[name]
        for one in frusta:
            if one.name not in self._shown:
                self._shown[one.name] = self._added(one)
            elif not _same(self._pictures[one.name], one.picture) and one.picture is not None:
                self._shown[one.name].image = one.picture.numpy()
            self._pictures[one.name] = one.picture

    def _added(self, one: Frustum) -> viser.CameraFrustumHandle:
        pose = one.pose
        w, x, y, z = pose.wxyz
        px, py, pz = pose.position
        return self._server.scene.add_camera_frustum(
            f"/cameras/{one.name}",
            pose.fov,
            pose.aspect,
            scale=self._scale,
            thickness=0.02 * self._scale,
            color=COLOR,
            image=None if one.picture is None else one.picture.numpy(),
            wxyz=(w, x, y, z),
            position=(px, py, pz),
        )


def _same(one: Tensor | None, other: Tensor | None) -> bool:
    return one is other or (one is not None and other is not None and torch.equal(one, other))
