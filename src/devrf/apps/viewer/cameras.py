"""Cameras of the browser, and the captured ones in the page's scene."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from kornia.geometry.conversions import (
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)
from torch import Tensor

from devrf.apps.captured_cameras import MAX_FRUSTA, frustum_depth, thumbnail
from devrf.apps.keyframes import Keyframe, keyframes_of
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.pictures.images import evenly
from devrf.scenes.scene import Scene
from devrf.scenes.validation import in_reach

if TYPE_CHECKING:
    import viser

# From OpenGL's camera axes (y up, z backwards) to OpenCV's (y down, z forwards), and back.
FLIP = (1.0, -1.0, -1.0)
COLOR = (40, 110, 170)
THICKNESS = 1.5
# The angles of view in degrees, and windows (width over height), that are rendered as they are.
FOVS = (1.0, 179.0)
ASPECTS = (0.1, 10.0)


def within(value: float, limits: tuple[float, float]) -> float:
    """``value``, or the limit that it is beyond; the lower one for NaN."""
    low, high = limits
    return min(high, max(low, value))


def from_browser(
    camera: viser.CameraHandle, time: float, seconds: float = 0.0
) -> tuple[Keyframe, float]:
    """The camera that a page is looked at from, at a time of the scene, and its aspect.

    A page may say anything: the angle of view and the aspect are brought within limits.

    Raises:
        DevrfError: the window has no area, as that of a collapsed tab, or the camera no pose.
    """
    try:
        pose = [*camera.wxyz, *camera.position]
        others = [camera.fov, camera.image_width, camera.image_height]
        numbers = torch.tensor([*pose, *others], dtype=torch.float64)
    except (TypeError, ValueError):
        numbers = torch.empty(0)
    if len(numbers) != 10 or not bool(in_reach(numbers)) or bool((numbers[8:] <= 0).any()):
        raise DevrfError("the page has no area, or its camera no pose that can be computed with")
    turned = quaternion_to_rotation_matrix(numbers[None, :4])[0] * numbers.new_tensor(FLIP)
    camera_to_world = torch.cat([turned, numbers[4:7, None]], dim=1).float()
    fov, width, height = numbers[7:].tolist()
    keyframe = Keyframe(camera_to_world, within(math.degrees(fov), FOVS), time, seconds)
    return keyframe, within(width / height, ASPECTS)


def in_browser(keyframe: Keyframe) -> tuple[np.ndarray, np.ndarray, float]:
    """A browser's camera: unit quaternion wxyz, position, vertical angle in radians."""
    pose = keyframe.camera_to_world.double().cpu()
    turned = pose[:, :3] * pose.new_tensor(FLIP)
    wxyz = rotation_matrix_to_quaternion(turned[None])[0]
    return wxyz.numpy(), pose[:, 3].numpy(), math.radians(keyframe.fov)


class Frustum(NamedTuple):
    """A captured camera; a fixed one has one name at every time, ``image`` is (H', W', 3) uint8."""

    name: str
    camera: Cameras
    image: Tensor | None


def dynamic_frusta(scene: Scene, time: float) -> list[Frustum]:
    """The cameras that saw the scene move, at one of their images' times."""
    views = scene.dynamic.train
    images = ((views.times - time).abs() < scene.clock.TOLERANCE).nonzero()[:, 0].tolist()
    return [
        Frustum(f"moving/{views.view[k]}", views.cameras.single(k), thumbnail(scene, views, k))
        for k in (images[j] for j in evenly(len(images), MAX_FRUSTA))
    ]


def static_frusta(cameras: Cameras, scene: Scene | None) -> list[Frustum]:
    """The cameras that saw the scene at rest, with images if there is a scene."""
    frusta = []
    for k in evenly(len(cameras), MAX_FRUSTA):
        image = None if scene is None else thumbnail(scene, scene.static.train, k)
        frusta.append(Frustum(f"static/{k}", cameras.single(k), image))
    return frusta


class FrustaLayer:
    """The captured cameras in the page's scene."""

    def __init__(self, server: viser.ViserServer, cameras: Cameras, scene: Scene | None) -> None:
        """Show none yet; ``cameras`` saw the scene at rest, their images are the ``scene``'s."""
        self._server = server
        self._cameras = cameras
        self._scene = scene
        self._depth = frustum_depth(cameras)
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
        self._shown = (static, nearest)
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
        wxyz, position, fov = in_browser(keyframes_of(frustum.camera, [0.0], 0.0)[0])
        fx, fy = frustum.camera.focal[0].tolist()
        aspect = (frustum.camera.width / fx) / (frustum.camera.height / fy)
        volume = math.tan(fov / 2) ** 2 * aspect / 3  # the same for all frusta of one scale
        return self._server.scene.add_camera_frustum(
            f"/cameras/{frustum.name}",
            fov,
            aspect,
            scale=self._depth * volume ** (1 / 3),
            thickness=THICKNESS,
            thickness_units="screen",
            color=COLOR,
            image=None if frustum.image is None else frustum.image.numpy(),
            wxyz=wxyz,
            position=position,
        )
