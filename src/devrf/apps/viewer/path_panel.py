"""The page's controls of a film: keyframes that are added, saved, loaded, flown through."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser

from devrf.apps.keyframes import CameraPath
from devrf.apps.path_files import check_name, path_from, write_path
from devrf.apps.viewer.path_editor import PathEditor
from devrf.apps.viewer.poses import Pose
from devrf.apps.viewer.presets import Preset
from devrf.apps.viewer.server import set_value
from devrf.errors import DevrfError

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
