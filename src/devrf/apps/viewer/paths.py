"""The page's controls of a video: keyframes that are added, saved, loaded, flown through."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser
from torch import Tensor

from devrf.apps.keyframes import (
    CameraPath,
    Keyframe,
    check_name,
    keyframes_of,
    path_from,
    write_path,
)
from devrf.apps.video import FilmSettings, bullet_time, orbit, spiral, time_freeze
from devrf.apps.viewer.cameras import Pose
from devrf.apps.viewer.controls import set_value
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.rendering.view import Viewable


class PathEditor:
    """A list of keyframes, changed by several threads."""

    def __init__(self) -> None:
        self._keyframes: tuple[Keyframe, ...] = ()
        self._lock = threading.Lock()

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """All of them, in their order."""
        return self._keyframes

    def add(self, camera_to_world: Tensor, fov: float, time: float, gap: float) -> None:
        """Add a keyframe after the others, ``gap`` seconds later.

        Args:
            camera_to_world: (3, 4), OpenGL axes, world units.
            fov: the vertical angle of view in degrees.
            time: the scene's, in [0, 1].
            gap: seconds, more than 0.
        """
        with self._lock:
            last = self._keyframes[-1:]
            seconds = last[0].seconds + gap if last else 0.0
            one = Keyframe(camera_to_world, fov, time, seconds)
            self._keyframes = (*self._keyframes, one)

    def remove_last(self) -> None:
        """Remove the newest keyframe, if there is one."""
        with self._lock:
            self._keyframes = self._keyframes[:-1]

    def replace(self, keyframes: tuple[Keyframe, ...]) -> None:
        """Take other keyframes, the first at second 0."""
        with self._lock:
            self._keyframes = tuple(
                replace(one, seconds=one.seconds - keyframes[0].seconds) for one in keyframes
            )

    def path(self, aspect: float, fps: float) -> CameraPath:
        """The path through the keyframes.

        Raises:
            DevrfError: there are fewer than two.
        """
        if len(self._keyframes) < 2:
            raise DevrfError("a path needs two keyframes; add the camera at two places or times")
        return CameraPath(self._keyframes, aspect, fps)


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


Act = Callable[[viser.GuiEvent[Any]], None]
# Points of the line that shows a path.
POINTS = 120


class PathPanel:
    """The panel; its files lie in a folder ``paths`` of the run."""

    def __init__(
        self,
        server: viser.ViserServer,
        folder: Path,
        height: int,
        presets: Mapping[str, Preset],
        fly: Callable[[CameraPath], None],
        changed: Callable[[], None],
    ) -> None:
        """Put the panel on the page.

        Args:
            server: of the page.
            folder: the run's.
            height: rows of pictures, for files that say so.
            presets: keyframes by name, from the scene's present time.
            fly: shows a path from its beginning to its end.
            changed: called when a path appears in the scene, or vanishes.
        """
        self.editor = PathEditor()
        self._server, self._folder, self._height = server, folder, height
        self._presets, self._fly, self._changed = presets, fly, changed
        self.time: Callable[[], float] = lambda: 0.0
        self._line: viser.LineSegmentsHandle | None = None
        gui = server.gui
        with gui.add_folder("Film", expand_by_default=False):
            self._count = gui.add_markdown("")
            self._on(gui.add_button("Add keyframe", icon=viser.Icon.PLUS), self._add)
            self._on(gui.add_button("Remove the last"), lambda _: self.editor.remove_last())
            self._on(gui.add_button("Remove all"), lambda _: self.editor.replace(()))
            self._gap = gui.add_number("seconds to it", 2.0, min=0.05, max=600.0, step=0.05)
            self._fps = gui.add_number("pictures/s", 24.0, min=1.0, max=120.0, step=1.0)
            self._aspect = gui.add_number(
                "width/height", 1.5, min=0.1, max=10.0, step=0.01, hint="of the film"
            )
            self._preset = gui.add_dropdown("path", tuple(presets), hint="a path that is known")
            self._on(gui.add_button("Take this path"), self._take)
            self._on(gui.add_button("Fly through"), lambda _: self._fly(self._path()))
            self._name = gui.add_text("name", "path")
            self._on(gui.add_button("Save"), self._save)
            self._upload = gui.add_upload_button("Load", mime_type="application/json")
            self._upload.on_upload(self._answer(self._load))
        self._draw()

    def _on(self, button: viser.GuiButtonHandle, act: Act) -> None:
        button.on_click(self._answer(act))

    def _answer(self, act: Act) -> Act:
        """``act``, which shows what is wrong, and the keyframes afterwards."""

        def answered(event: viser.GuiEvent[Any]) -> None:
            try:
                act(event)
            except (DevrfError, OSError) as error:
                self._say(event, "Not done", str(error))
            before = self.drawn
            self._draw()
            if before != self.drawn:
                self._changed()

        return answered

    def _say(self, event: viser.GuiEvent[Any], title: str, text: str) -> None:
        if event.client is not None:
            event.client.add_notification(title, text, auto_close_seconds=20)

    def _add(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is None:
            return
        camera = event.client.camera
        pose = Pose.of_browser(camera)
        angle = float(np.degrees(camera.fov))
        self.editor.add(pose.camera_to_world.float(), angle, self.time(), float(self._gap.value))

    def _take(self, _: object) -> None:
        self.editor.replace(self._presets[self._preset.value](self.time()))

    def _path(self) -> CameraPath:
        return self.editor.path(float(self._aspect.value), float(self._fps.value))

    def _save(self, event: viser.GuiEvent[Any]) -> None:
        file = self._folder / "paths" / f"{check_name(self._name.value)}.json"
        write_path(file, self._path(), self._height)
        command = f"`python -m devrf stage=render hydra.run.dir={self._folder} video.path={file}`"
        self._say(event, f"Saved {file.name}", f"Film it with {command}")

    def _load(self, _: object) -> None:
        given = self._upload.value
        path = path_from(given.content, given.name)
        self.editor.replace(path.keyframes)
        set_value(self._fps, min(max(path.fps, 1.0), 120.0))
        set_value(self._aspect, min(max(path.aspect, 0.1), 10.0))

    @property
    def drawn(self) -> bool:
        """Whether a path is drawn into the scene."""
        return self._line is not None

    def _draw(self) -> None:
        """Show how many keyframes there are, and the way through them."""
        keyframes = self.editor.keyframes
        seconds = keyframes[-1].seconds if keyframes else 0.0
        self._count.content = f"{len(keyframes)} keyframes, {seconds:g} s"
        if self._line is not None:
            self._line.remove()
            self._line = None
        if len(keyframes) < 2:
            return
        shown = CameraPath(keyframes, 1.0, 1.0).sampled(POINTS)
        way = torch.stack([one.camera_to_world[:, 3] for one in shown]).numpy()
        self._line = self._server.scene.add_line_segments(
            "/film",
            np.stack([way[:-1], way[1:]], axis=1),
            colors=(200, 60, 40),
            thickness=2.0,
            thickness_units="screen",
        )
