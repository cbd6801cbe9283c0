"""The page's controls of a video: keyframes that are added, saved, loaded, flown through."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser

from devrf.apps.camera_paths import CAMERA_PATHS, bullet_time, default_path, looked_at, time_freeze
from devrf.apps.captured_cameras import distance_ahead
from devrf.apps.keyframes import (
    CameraPath,
    Keyframe,
    check_name,
    keyframes_of,
    path_from,
    write_path,
)
from devrf.apps.video import VideoSettings
from devrf.apps.viewer.cameras import from_browser
from devrf.apps.viewer.controls import choice_of, number_of, set_value
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.offset import Offset
from devrf.rendering.renderable import Renderable
from devrf.system.override import to_type

# Keyframes of a known path, and the seconds that it takes to go round.
KEYFRAMES = 13
SECONDS = 8.0
# Points of the line that shows a path.
POINTS = 120
# Known paths of scenes that move.
IN_TIME = ("bullet time", "time freeze")
# Keyframes from a time in [0, 1], at which the video is to stop.
Preset = Callable[[float], tuple[Keyframe, ...]]
Act = Callable[[viser.GuiEvent[Any]], None]


def known_paths(cameras: Cameras, model: Callable[[], Renderable]) -> dict[str, Preset]:
    """The paths that ``video.path`` names, with the time, from the static ``cameras``."""
    once = VideoSettings(frames=KEYFRAMES)
    longer = VideoSettings(frames=3 * KEYFRAMES)
    times = torch.linspace(0, 1, KEYFRAMES).tolist()

    def filmed(name: str, video: VideoSettings) -> Cameras:
        target = looked_at(model(), cameras, lambda: distance_ahead(cameras))
        if name == "captured":
            return CAMERA_PATHS[name](cameras, target, replace(video, fps=KEYFRAMES / SECONDS))
        # Comes back to where it began.
        video = replace(video, frames=video.frames - 1)
        return CAMERA_PATHS[name](cameras, target, video)[[*range(video.frames), 0]]

    def running(name: str, _: float) -> tuple[Keyframe, ...]:
        return keyframes_of(filmed(name, once), times, SECONDS)

    def ring(video: VideoSettings) -> Cameras:
        return filmed(default_path(model().space, closed=True), video)

    def stopped(shoot: Any, video: VideoSettings, stop: float) -> tuple[Keyframe, ...]:
        shots, shot_times = shoot(ring, stop, video)
        return keyframes_of(shots, shot_times, SECONDS * video.frames / KEYFRAMES)

    return {
        **{name: partial(running, name) for name in CAMERA_PATHS},
        "bullet time": partial(stopped, bullet_time, once),
        "time freeze": partial(stopped, time_freeze, longer),
    }


class PathPanel:
    """The panel; its files lie in a folder ``paths`` of the run.

    Attributes:
        keyframes: those collected so far, the first at second 0.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        folder: Path,
        run: Sequence[str],
        height: int,
        presets: Mapping[str, Preset],
        time: Callable[[], float],
        fly: Callable[[CameraPath], None],
        changed: Callable[[], None],
        offset: Offset,
    ) -> None:
        """Put the panel on the page.

        ``folder`` is the run's, and ``run`` the words that name it in a command; ``height`` the
        rows of frames, for files that say so; ``presets`` are keyframes from the current ``time``
        in [0, 1]. ``fly`` shows a path from its beginning to its end; ``changed`` is called when a
        path appears in the scene, or vanishes. Positions in files have the scene's ``offset``.
        """
        self.keyframes: tuple[Keyframe, ...] = ()
        self._server = server
        self._folder = folder
        self._run = run
        self._height = height
        self._time = time
        self._changed = changed
        self._offset = offset
        self._line: viser.LineSegmentsHandle | None = None
        gui = server.gui
        with gui.add_folder("Video", expand_by_default=False):
            self._count = gui.add_markdown("")
            self._button("Add keyframe", self._add, viser.Icon.PLUS)
            self._button("Remove the last", lambda _: self._take(self.keyframes[:-1]))
            self._button("Remove all", lambda _: self._take(()))
            self._gap = gui.add_number("seconds to it", 2.0, min=0.05, max=600.0, step=0.05)
            self._fps = gui.add_number("pictures/s", 24.0, min=1.0, max=120.0, step=1.0)
            self._aspect = gui.add_number(
                "width/height", 1.5, min=0.1, max=10.0, step=0.01, hint="of the video"
            )
            self._presets = tuple(presets)
            self._preset: Any = gui.add_dropdown("path", self._presets, hint="a path that is known")
            self._button(
                "Take this path", lambda _: self._take(presets[choice_of(self._preset)](time()))
            )
            self._button("Fly through", lambda _: fly(self.path()))
            self._name = gui.add_text("name", "path")
            self._button("Save", self._save)
            self._command = gui.add_text("film it with", "", multiline=True, visible=False)
            self._upload = gui.add_upload_button("Load", mime_type="application/json")
            self._upload.on_upload(self._answer(self._load))
        self._draw()

    def offer(self, at_rest: bool) -> None:
        """Offer the known paths of a scene, with the time if it is not ``at_rest``."""
        self._preset.options = [k for k in self._presets if not (at_rest and k in IN_TIME)]

    @property
    def drawn(self) -> bool:
        """Whether a path is drawn into the scene."""
        return self._line is not None

    def path(self) -> CameraPath:
        """The path through the keyframes.

        Raises:
            DevrfError: there are fewer than two.
        """
        if len(self.keyframes) < 2:
            raise DevrfError("a path needs two keyframes; add the camera at two places or times")
        return CameraPath(self.keyframes, number_of(self._aspect), number_of(self._fps))

    def _button(self, label: str, act: Act, icon: viser.IconName | None = None) -> None:
        self._server.gui.add_button(label, icon=icon).on_click(self._answer(act))

    def _answer(self, act: Act) -> Act:
        """``act``, which shows what is wrong, and the keyframes afterwards."""

        def answered(event: viser.GuiEvent[Any]) -> None:
            try:
                act(event)
            except (DevrfError, OSError) as error:
                if event.client is not None:
                    event.client.add_notification("Not done", str(error), auto_close_seconds=20)
            before = self.drawn
            self._draw()
            if before != self.drawn:
                self._changed()

        return answered

    def _add(self, event: viser.GuiEvent[Any]) -> None:
        """Add the camera of the page after the other keyframes."""
        if event.client is None:
            return
        last = self.keyframes[-1:]
        seconds = last[0].seconds + number_of(self._gap) if last else 0.0
        added, _ = from_browser(event.client.camera, self._time(), seconds)
        self.keyframes = (*self.keyframes, added)

    def _take(self, keyframes: tuple[Keyframe, ...]) -> None:
        """Take other keyframes, the first at second 0."""
        first = keyframes[0].seconds if keyframes else 0.0
        self.keyframes = tuple(replace(key, seconds=key.seconds - first) for key in keyframes)

    def _save(self, _: object) -> None:
        file = self._folder / "paths" / f"{check_name(self._name.value)}.json"
        write_path(file, self.path(), self._height, self._offset)
        words = ["python", "-m", "devrf", "stage=render", *self._run, to_type("video.path", file)]
        set_value(self._command, " ".join(words))
        self._command.visible = True

    def _load(self, _: object) -> None:
        upload = self._upload.value
        path = path_from(upload.content, upload.name, self._offset)
        self._take(path.keyframes)
        set_value(self._fps, min(max(path.fps, 1.0), 120.0))
        set_value(self._aspect, min(max(path.aspect, 0.1), 10.0))

    def _draw(self) -> None:
        """Show the number of keyframes, and the path through them."""
        seconds = self.keyframes[-1].seconds if self.keyframes else 0.0
        self._count.content = f"{len(self.keyframes)} keyframes, {seconds:g} s"
        if self._line is not None:
            self._line.remove()
            self._line = None
        if len(self.keyframes) < 2:
            return
        keyframes = CameraPath(self.keyframes, 1.0, 1.0).sampled(POINTS)
        points = torch.stack([keyframe.camera_to_world[:, 3] for keyframe in keyframes]).numpy()
        self._line = self._server.scene.add_line_segments(
            "/video",
            np.stack([points[:-1], points[1:]], axis=1),
            colors=(200, 60, 40),
            thickness=2.0,
            thickness_units="screen",
        )
