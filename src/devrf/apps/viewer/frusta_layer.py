"""The captured cameras in the page's scene."""

from __future__ import annotations

import threading

import torch
import viser
from torch import Tensor

from devrf.apps.viewer.frusta import (
    Frustum,
    bare_frusta,
    frustum_scale,
    moving_frusta,
    resting_frusta,
)
from devrf.checkpoints.viewpoints import Viewpoints
from devrf.scenes.scene import Scene

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
