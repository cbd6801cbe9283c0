"""The viewer: a page that shows a learned scene to everyone who has it open."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import threading
import time
from collections.abc import Hashable
from pathlib import Path

import torch
import viser

from devrf.apps.keyframes import CameraPath
from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.cameras import FrustaLayer, Pose
from devrf.apps.viewer.controls import Controls
from devrf.apps.viewer.drawing import Drawing, Picture, RenderScheduler, Shot
from devrf.apps.viewer.paths import PathPanel, distance_ahead, known_paths
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.rendering.view import Viewable
from devrf.scenes.scene import Scene


def open_server(settings: ViewerSettings) -> viser.ViserServer:
    """A server at the address of the settings; the caller stops it.

    Raises:
        DevrfError: the address is in use, or not this machine's.
    """
    settings.check_free()
    logging.getLogger("websockets").setLevel(logging.WARNING)
    with quiet():
        server = viser.ViserServer(settings.host, settings.port, label="devrf", verbose=False)
    if server.get_port() != settings.port:  # it takes the next one that is free
        stop_server(server)
        raise DevrfError(
            f"viewer.port: {settings.port} on {settings.host} is in use by another program; "
            "give another"
        )
    # Its share button would give the page to a server elsewhere.
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # beside the picture, not on it
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Take a server from the network."""
    with quiet():
        server.stop()


def quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """A block in which the server prints no banner."""
    return contextlib.redirect_stdout(io.StringIO())


log = logging.getLogger(__name__)

# Seconds between looks at the clock while nothing is to be rendered.
TICK = 0.02
# Of JPEG pictures: those of a moving scene are small.
COARSE_QUALITY, FULL_QUALITY = 70, 92


class Session:
    """The page's server, its controls and its renderer; pictures come from one thread.

    Attributes:
        scheduler: renders; None before :meth:`present`.
        pictures: how many have been shown.
    """

    def __init__(
        self,
        settings: ViewerSettings,
        viewpoints: Viewpoints,
        scene: Scene | None,
        folder: Path,
        stop: threading.Event | None = None,
    ) -> None:
        """Open the page; there is nothing on it before :meth:`present`.

        Args:
            settings: where it listens, how fine pictures are.
            viewpoints: the captured cameras, and what is behind the scene.
            scene: with its images, for the cameras' pictures; None where they cannot be read.
            folder: of the run: saved paths go below it.
            stop: ends :meth:`serve` once it is set, within the time of a block of rays.

        Raises:
            DevrfError: the address is in use, or not this machine's.
        """
        self.settings, self.viewpoints = settings, viewpoints
        self.scheduler: RenderScheduler | None = None
        self.pictures = 0
        self._drawing: Drawing | None = None
        self._stop = stop or threading.Event()
        self._flight: tuple[CameraPath, float] | None = None
        self._ticked = time.monotonic()
        self.server = open_server(settings)
        self.controls = Controls(self.server, self.refresh)
        paths = known_paths(viewpoints.static, lambda: self._model)
        self._films = PathPanel(
            self.server, folder, settings.height, paths, self._fly, self.refresh
        )
        self._films.time = lambda: self.controls.playback.time
        self._frusta = FrustaLayer(self.server, viewpoints, scene)
        self.controls.moving.visible = scene is not None and scene.moves
        self._place_camera()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    def present(self, drawing: Drawing) -> None:
        """Show this scene from now on."""
        self._drawing = drawing
        if self.scheduler is None:
            self.scheduler = RenderScheduler(
                drawing,
                self._show,
                height=self.settings.height,
                move_seconds=self.settings.move_seconds,
                stop=self._stop,
            )
        self.scheduler.drawing = drawing
        self.controls.offer(drawing)
        self.refresh()

    def serve(self) -> None:
        """Render what is asked for until it is stopped, from the calling thread."""
        assert self.scheduler is not None
        while not self._stop.is_set():
            self.step(TICK)

    def step(self, timeout: float) -> bool:
        """Let time run, and render one picture, waiting ``timeout`` seconds for its cause."""
        assert self.scheduler is not None
        now = time.monotonic()
        seconds, self._ticked = now - self._ticked, now
        if self._flight is not None:
            self._follow(now)
        elif self.controls.advance(min(seconds, 1.0)):
            self.refresh()
        return self.scheduler.render_next(timeout)

    def close(self) -> None:
        """Take the page from the network."""
        self._stop.set()
        stop_server(self.server)

    def refresh(self) -> None:
        """Ask for the pictures of all who have the page open."""
        for client in self.server.get_clients().values():
            self._ask(client)
        self._show_cameras()

    def _ask(self, client: viser.ClientHandle) -> None:
        camera = client.camera
        if self.scheduler is None or not camera.image_height:
            return
        pose = Pose.of_browser(camera)
        box = self._model.space.inner(self._model.box)
        shot = self.controls.shot(pose, box, with_depth=self._films.drawn)
        self.scheduler.ask(client.client_id, shot)

    @property
    def _model(self) -> Viewable:
        assert self._drawing is not None
        return self._drawing.renderer.model

    def _show(self, key: Hashable, shot: Shot, picture: Picture) -> None:
        client = self.server.get_clients().get(key)  # type: ignore[call-overload]
        if client is None:
            return
        rows = len(picture.pixels)
        full = rows >= self.settings.height
        client.scene.set_background_image(
            picture.pixels.numpy(),
            format="jpeg",
            jpeg_quality=FULL_QUALITY if full else COARSE_QUALITY,
            depth=None if picture.depth is None else picture.depth.numpy(),
        )
        self.pictures += 1
        if full or not self.controls.playback.playing:
            self.controls.say(f"{rows} rows in {picture.seconds:.2f} s")

    def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self._ask(client))
        self._ask(client)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        if self.scheduler is not None:
            self.scheduler.drop(client.client_id)

    def _show_cameras(self) -> None:
        controls = self.controls
        self._frusta.show(controls.moving.value, controls.resting.value, controls.playback.time)

    def _place_camera(self) -> None:
        """Begin where the held-out camera is, with the cameras' mean up."""
        static, held_out = self.viewpoints.static, self.viewpoints.held_out
        up = static.camera_to_world[:, :, 1].mean(dim=0)
        self.server.scene.set_up_direction((float(up[0]), float(up[1]), float(up[2])))
        start = self.server.initial_camera
        pose = Pose.of_cameras(held_out, 0)
        where, ahead = held_out.positions[0], held_out.forwards[0]
        look_at = where + distance_ahead(static) * ahead
        start.position = (float(where[0]), float(where[1]), float(where[2]))
        start.look_at = (float(look_at[0]), float(look_at[1]), float(look_at[2]))
        start.fov = pose.fov

    def _fly(self, path: CameraPath) -> None:
        self._flight = (path, time.monotonic())

    def _follow(self, now: float) -> None:
        """Take all cameras along the path that is being flown."""
        assert self._flight is not None
        path, began = self._flight
        first = path.keyframes[0].seconds
        gone = min(now - began, path.duration)
        if gone >= path.duration:
            self._flight = None
        shown = path.at(torch.tensor([first + gone]))[0]
        self.controls.set_time(shown.time)
        pose = Pose.of(shown.camera_to_world, math.radians(shown.fov), path.aspect)
        w, x, y, z = pose.wxyz
        px, py, pz = pose.position
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.position = (px, py, pz)
                client.camera.wxyz = (w, x, y, z)
                client.camera.fov = pose.fov
            self._ask(client)
        self._show_cameras()
