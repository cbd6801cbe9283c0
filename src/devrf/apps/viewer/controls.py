"""Controls of the page: current time, channel, cameras, crop."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import viser

from devrf.apps.viewer.cameras import from_browser, within
from devrf.apps.viewer.drawing import Drawing, Shot
from devrf.geometry.box import Box

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
# Duration of the whole recording at speed 1, in seconds.
DURATION = 5.0


@dataclass(frozen=True)
class Playback:
    """The state of the time controls: the time in [0, 1], and its playback.

    Attributes:
        loop: whether it restarts at its end; otherwise it stops there.
        speed: recordings for each :data:`DURATION` seconds.
    """

    time: float = 0.0
    playing: bool = False
    loop: bool = True
    speed: float = 1.0

    def advanced(self, seconds: float) -> Playback:
        """The state ``seconds`` later."""
        if not self.playing:
            return self
        time = self.time + seconds * self.speed / DURATION
        if time <= 1:
            return replace(self, time=time)
        return replace(self, time=time % 1) if self.loop else replace(self, time=1.0, playing=False)

    def toggled(self) -> Playback:
        """Time stands if it ran, else it runs: from its beginning where it stood at its end."""
        if self.playing:
            return replace(self, playing=False)
        return replace(self, playing=True, time=0.0 if self.time >= 1 else self.time)


def set_value(control: Any, value: object) -> None:
    """Set the value of a control of the page; its type takes it for read-only."""
    control.value = value


def number_of(control: Any) -> float:
    """The number that a control shows, within its limits: a page may send any."""
    return within(control.value, (control.min, control.max))


def choice_of(control: Any) -> Any:
    """The chosen option of a control; the first, if a page has sent something else."""
    return control.value if control.value in control.options else control.options[0]


class Controls:
    """The page's controls, the same for all who have it open.

    Attributes:
        playback: the time that is shown, and whether it runs.
    """

    def __init__(self, server: viser.ViserServer, changed: Callable[[], None]) -> None:
        """Put them on the page; ``changed`` is called, from any thread, to render again."""
        self.playback = Playback()
        self._lock = threading.Lock()
        self._changed = changed
        gui = server.gui
        self._told = gui.add_markdown("", visible=False)
        self._timing = gui.add_folder("Time")
        with self._timing:
            self._time = gui.add_slider("time", 0.0, 1.0, 0.001, 0.0, hint="0 is the rest state")
            self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
            self._loop = gui.add_checkbox("loop", True)
            hint = f"1: all of it in {DURATION:g} seconds"
            self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1", hint=hint)
            hint = "show the frame that is being learned"
            self._follow = gui.add_checkbox("follow", True, visible=False, hint=hint)
        with gui.add_folder("Picture"):
            self._channel: Any = gui.add_dropdown("show", ("color",))
            self._part: Any = gui.add_dropdown("part", ("all",), visible=False)
            self._rest = gui.add_checkbox("rest beside", False, hint="the rest state on the left")
            self._status = gui.add_markdown("")
        with gui.add_folder("Cameras", expand_by_default=False):
            self.dynamic = gui.add_checkbox("in motion", False, hint="with their pictures then")
            self.static = gui.add_checkbox("at rest", False, hint="with their pictures at rest")
        with gui.add_folder("Crop", expand_by_default=False):
            self._crop = gui.add_checkbox("crop", False)
            self._sides = [
                gui.add_multi_slider(axis, 0, 100, 1, (0, 100), min_range=1, hint="% of the box")
                for axis in "xyz"
            ]
        self._cropped_by: int | None = None
        self._time.on_update(self._time_set)
        self._play.on_click(self._play_pressed)
        self._loop.on_update(self._pace_set)
        self._speed.on_update(self._pace_set)
        # Frusta would not lie where two pictures show the scene.
        scene = server.scene
        rest = self._rest
        rest.on_update(lambda _: scene.set_global_visibility(not rest.value))
        boxes: list[Any] = [self._channel, self._part, rest, self.dynamic, self.static]
        crop: list[Any] = [self._crop, *self._sides]
        for control in (*boxes, *crop):
            control.on_update(lambda _: self._changed())
        for control in crop:
            control.on_update(self._crop_set)

    def offer(self, drawing: Drawing) -> None:
        """Offer the channels of a scene."""
        channel = self._channel.value
        self._channel.options = drawing.channels
        set_value(self._channel, channel if channel in drawing.channels else "color")
        self._part.options = ("all", *drawing.parts)
        self._part.visible = bool(drawing.parts)
        self._rest.visible = drawing.has_rest
        self._timing.visible = not drawing.at_rest

    def advance(self, seconds: float) -> bool:
        """Let time run for ``seconds``; whether it has changed."""
        before = self.playback
        self._change(lambda now: now.advanced(seconds))
        if before == self.playback:
            return False
        set_value(self._time, self.playback.time)
        return True

    def set_time(self, time: float) -> None:
        """Show another time, at which time stands."""
        self._change(lambda now: replace(now, time=time, playing=False))
        set_value(self._time, time)

    def shot(self, camera: viser.CameraHandle, box: Box, *, with_depth: bool) -> Shot:
        """The frame to be rendered for a page's camera; the crop is a part of the ``box``.

        ``with_depth``: whether something beside frusta is drawn into the scene.

        Raises:
            DevrfError: the page's camera cannot be rendered.
        """
        crop = None
        if self._crop.value:
            shares = [[within(end, (0, 100)) / 100 for end in side.value] for side in self._sides]
            sides = list(zip(box.low, box.size, map(min, shares), map(max, shares), strict=True))
            crop = Box.of(
                [low + size * first for low, size, first, _ in sides],
                [low + size * max(last, first + 0.01) for low, size, first, last in sides],
            )
        with_depth = with_depth or self.dynamic.value or self.static.value
        beside = self._rest.value and self._rest.visible
        keyframe, aspect = from_browser(camera, self.playback.time)
        shown = choice_of(self._channel), choice_of(self._part)
        return Shot(keyframe, aspect, *shown, beside, crop, with_depth)

    def show_status(self, text: str) -> None:
        """Show a line below the choice of channels."""
        self._status.content = text

    def tell(self, text: str) -> None:
        """Show the scene's present stage at the top of the page."""
        self._told.content = text
        self._told.visible = True

    def follow(self, time: float | None) -> None:
        """Show the time that is being learned, if it is one, and none was chosen on the page."""
        self._follow.visible = time is not None
        if time is not None and self._follow.value and time != self.playback.time:
            self.set_time(time)

    def left(self, client: int) -> None:
        """A page was closed: the crop that it set goes with it."""
        if client == self._cropped_by:
            set_value(self._crop, False)
            for slider in self._sides:
                set_value(slider, (0, 100))

    def _crop_set(self, event: viser.GuiEvent[Any]) -> None:
        if event.client_id is not None:
            self._cropped_by = event.client_id

    def _change(self, change: Callable[[Playback], Playback]) -> None:
        """Change the playback, and its button's label."""
        with self._lock:  # the clock and the page change it
            self.playback = change(self.playback)
        playing = self.playback.playing
        if self._play.label != ("Pause" if playing else "Play"):
            self._play.label = "Pause" if playing else "Play"
            self._play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

    def _time_set(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is None:  # set by this program
            return
        set_value(self._follow, False)
        self._change(lambda now: replace(now, time=number_of(self._time)))
        self._changed()

    def _play_pressed(self, _: object) -> None:
        set_value(self._follow, False)
        self._change(Playback.toggled)
        self._changed()

    def _pace_set(self, _: object) -> None:
        loop = bool(self._loop.value)
        speed = float(choice_of(self._speed))
        self._change(lambda now: replace(now, loop=loop, speed=speed))
