"""The viewer: a page that shows a learned scene to everyone who has it open."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
import viser

from devrf.apps.camera_paths import upward
from devrf.apps.captured_cameras import distance_ahead
from devrf.apps.keyframes import CameraPath, keyframes_of
from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.cameras import FrustaLayer, in_browser
from devrf.apps.viewer.controls import Controls
from devrf.apps.viewer.drawing import Drawing, Frame, RenderScheduler
from devrf.apps.viewer.paths import PathPanel, known_paths
from devrf.apps.viewer.server import open_server, quiet
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.rendering.renderable import Renderable
from devrf.scenes.scene import Scene
from devrf.system.override import to_type

log = logging.getLogger(__name__)

# Seconds between looks at the clock while nothing is to be rendered.
TICK = 0.02
# JPEG's quality for full frames. Coarse ones are enlarged, which would show its blocks and halos.
QUALITY = 92


class Session:
    """The page's server, its controls and its renderer; frames come from one thread.

    Attributes:
        scheduler: renders; None before :meth:`present`.
        frames: the number of frames that have been shown.
    """

    def __init__(
        self,
        settings: ViewerSettings,
        viewpoints: Viewpoints,
        scene: Scene | None,
        folder: Path,
        ckpt: str | None = None,
    ) -> None:
        """Open the page; there is nothing on it before :meth:`present`.

        The cameras have pictures if there is a ``scene``. Saved paths go below the run's
        ``folder``. Commands that the page tells are for this run, or for ``ckpt`` if it is given.

        Raises:
            DevrfError: the address is in use, or not this machine's.
        """
        self.settings = settings
        self.viewpoints = viewpoints
        self.scheduler: RenderScheduler | None = None
        self.frames = 0
        self._stop = threading.Event()
        self._flight: tuple[CameraPath, float] | None = None
        self._ticked = time.monotonic()
        self._failures: set[str] = set()
        self.server = open_server(settings)
        self.controls = Controls(self.server, self.refresh)
        learned = [] if ckpt is None else [to_type("ckpt", Path(ckpt).resolve())]
        self.paths = PathPanel(
            self.server,
            folder,
            [to_type("hydra.run.dir", folder), *learned],
            settings.height,
            known_paths(viewpoints.static, lambda: self._model),
            time=lambda: self.controls.playback.time,
            fly=self._fly,
            changed=self.refresh,
            offset=viewpoints.offset,
        )
        self._frusta = FrustaLayer(self.server, viewpoints.static, scene)
        self.controls.dynamic.visible = scene is not None and scene.moves
        self._place_camera()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    def present(self, drawing: Drawing) -> None:
        """Show this scene from now on."""
        if self.scheduler is None:
            self.scheduler = RenderScheduler(drawing, self._show, self.settings, self._stop)
        self.scheduler.drawing = drawing
        self.controls.offer(drawing)
        self.paths.offer(drawing.at_rest)
        self.refresh()

    def serve(self) -> None:
        """Render requested frames until :meth:`stop`, from the calling thread."""
        log.info("the scene is at %s; Ctrl-C ends the viewer", self.settings.address)
        while not self._stop.is_set():
            with self.surviving():
                self.step(TICK)
        log.info("the viewer has ended")

    @contextmanager
    def surviving(self) -> Iterator[None]:
        """A block whose errors end neither viewer nor learning; the first of a kind is logged."""
        try:
            yield
        except Exception as error:
            kind = type(error).__name__
            if kind not in self._failures:
                self._failures.add(kind)
                reason = str(error).partition("\n")[0]
                log.warning("viewer: %s: %s; it goes on, and says this once", kind, reason)

    def stop(self) -> None:
        """End :meth:`serve`, within the time of a block of rays."""
        self._stop.set()

    def step(self, timeout: float) -> bool:
        """Let time run, and render one frame, waiting ``timeout`` seconds for its cause."""
        assert self.scheduler is not None
        now = time.monotonic()
        seconds = now - self._ticked
        self._ticked = now
        if self._flight is not None:
            self._follow(now)
        elif self.controls.advance(min(seconds, 1.0)):
            self.refresh()
        return self.scheduler.render_next(timeout)

    def close(self) -> None:
        """Take the page from the network."""
        self.stop()
        with quiet():
            self.server.stop()

    def refresh(self) -> None:
        """Ask for the frames of all who have the page open."""
        for client in self.server.get_clients().values():
            self._ask(client)
        self._show_cameras()

    def _ask(self, client: viser.ClientHandle) -> None:
        if self.scheduler is None:
            return
        box = self._model.space.inner(self._model.box)
        try:
            shot = self.controls.shot(client.camera, box, with_depth=self.paths.drawn)
        except DevrfError:  # there is nothing to render for such a page
            self.scheduler.drop(client.client_id)
        else:
            self.scheduler.ask(client.client_id, shot)

    @property
    def _model(self) -> Renderable:
        assert self.scheduler is not None
        return self.scheduler.drawing.renderer.model

    def _show(self, key: Hashable, frame: Frame) -> None:
        client = self.server.get_clients().get(key)  # type: ignore[call-overload]
        if client is None:
            return
        rows = len(frame.pixels)
        full = rows >= self.settings.height
        client.scene.set_background_image(
            frame.pixels.numpy(),
            format="jpeg" if full else "png",
            jpeg_quality=QUALITY,
            depth=None if frame.depth is None else frame.depth.numpy(),
        )
        self.frames += 1
        if full or not self.controls.playback.playing:
            self.controls.show_status(f"{rows} rows in {frame.seconds:.2f} s")

    def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self._ask(client))
        self._ask(client)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        if self.scheduler is not None:
            self.scheduler.drop(client.client_id)
        self.controls.left(client.client_id)

    def _show_cameras(self) -> None:
        controls = self.controls
        self._frusta.show(controls.dynamic.value, controls.static.value, controls.playback.time)

    def _place_camera(self) -> None:
        """Begin where the held-out camera is, with what is up to the cameras."""
        static = self.viewpoints.static
        held_out = self.viewpoints.held_out
        self.server.scene.set_up_direction(upward(static).numpy())
        start = self.server.initial_camera
        target = held_out[[0]]
        ahead = target.positions[0] + distance_ahead(static) * target.forwards[0]
        _, start.position, start.fov = in_browser(keyframes_of(target, [0.0], 0.0)[0])
        start.look_at = ahead.numpy()

    def _fly(self, path: CameraPath) -> None:
        self._flight = (path, time.monotonic())

    def _follow(self, now: float) -> None:
        """Take all cameras along the path that is being flown."""
        assert self._flight is not None
        path, began = self._flight
        seconds = min(now - began, path.duration)
        if seconds >= path.duration:
            self._flight = None
        keyframe = path.at(torch.tensor([path.keyframes[0].seconds + seconds]))[0]
        self.controls.set_time(keyframe.time)
        wxyz, position, fov = in_browser(keyframe)
        for client in self.server.get_clients().values():
            # A page may give its camera values that viser cannot move.
            with self.surviving(), client.atomic():
                client.camera.position = position
                client.camera.wxyz = wxyz
                client.camera.fov = fov
            self._ask(client)
        self._show_cameras()
