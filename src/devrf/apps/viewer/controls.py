"""What is chosen on the page: time, picture, cameras, crop."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import viser

from devrf.apps.viewer.cameras import Pose
from devrf.apps.viewer.drawing import Drawing, Shot
from devrf.geometry.box import Box

# How long the whole recording takes at speed 1, in seconds.
DURATION = 5.0


@dataclass(frozen=True)
class Playback:
    """The state of the time controls.

    Attributes:
        time: in [0, 1].
        playing: whether time runs.
        loop: whether it begins anew at its end; otherwise it stops there.
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

    def started(self) -> Playback:
        """Time runs, from its beginning where it stood at its end."""
        return replace(self, playing=True, time=0.0 if self.time >= 1 else self.time)


SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


def set_value(control: Any, value: object) -> None:
    """Set what a control of the page shows; its type takes it for read-only."""
    control.value = value


class Controls:
    """The page's controls, the same for all who have it open."""

    def __init__(self, server: viser.ViserServer, changed: Callable[[], None]) -> None:
        """Put them on the page.

        Args:
            server: of the page.
            changed: called when a picture must be rendered anew; from any thread.
        """
        self._playback, self._lock, self._changed = Playback(), threading.Lock(), changed
        gui = server.gui
        with gui.add_folder("Time"):
            self._time = gui.add_slider("time", 0.0, 1.0, 0.001, 0.0, hint="0 is the rest state")
            self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
            self._loop = gui.add_checkbox("loop", True)
            hint = f"1: all of it in {DURATION:g} seconds"
            self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1", hint=hint)
        with gui.add_folder("Picture"):
            channels: tuple[str, ...] = ("color",)
            self._channel = gui.add_dropdown("show", channels)
            self._rest = gui.add_checkbox("rest beside", False, hint="the rest state on the left")
            self._status = gui.add_markdown("")
        with gui.add_folder("Cameras", expand_by_default=False):
            self.moving = gui.add_checkbox("in motion", False, hint="with their pictures then")
            self.resting = gui.add_checkbox("at rest", False, hint="with their pictures at rest")
        with gui.add_folder("Crop", expand_by_default=False):
            self._crop = gui.add_checkbox("crop", False)
            self._sides = [
                gui.add_multi_slider(axis, 0, 100, 1, (0, 100), min_range=1, hint="% of the box")
                for axis in "xyz"
            ]
        self._time.on_update(self._time_set)
        self._play.on_click(self._play_pressed)
        for one in (self._loop, self._speed):
            one.on_update(self._pace_set)
        every: list[Any] = [self._channel, self._rest, self.moving, self.resting]
        for one in (*every, self._crop, *self._sides):
            one.on_update(lambda _: self._changed())

    @property
    def playback(self) -> Playback:
        """The time that is shown, and whether it runs."""
        return self._playback

    def offer(self, drawing: Drawing) -> None:
        """Offer what can be shown of a scene."""
        chosen = self._channel.value
        self._channel.options = drawing.channels
        set_value(self._channel, chosen if chosen in drawing.channels else "color")
        self._rest.visible = drawing.has_rest
        for one in (self._time, self._play, self._loop, self._speed):
            one.disabled = drawing.at_rest

    def advance(self, seconds: float) -> bool:
        """Let time run for ``seconds``; whether it has changed."""
        before = self._change(lambda now: now.advanced(seconds))
        if before == self._playback:
            return False
        set_value(self._time, self._playback.time)
        self._label()
        return True

    def set_time(self, time: float) -> None:
        """Show another time, at which time stands."""
        self._change(lambda now: replace(now, time=time, playing=False))
        set_value(self._time, time)
        self._label()

    def shot(self, pose: Pose, box: Box, *, with_depth: bool) -> Shot:
        """What a camera is to show.

        Args:
            pose: the camera.
            box: what the crop is a part of.
            with_depth: whether something beside frusta is drawn into the scene.
        """
        crop = None
        if self._crop.value:
            ends = [[share / 100 for share in one.value] for one in self._sides]
            low, size = box.low, box.size
            crop = Box.of(
                [low[k] + ends[k][0] * size[k] for k in range(3)],
                [low[k] + max(ends[k][1], ends[k][0] + 0.01) * size[k] for k in range(3)],
            )
        with_depth = with_depth or self.moving.value or self.resting.value
        beside = self._rest.value and self._rest.visible
        return Shot(pose, self._playback.time, self._channel.value, beside, crop, with_depth)

    def say(self, text: str) -> None:
        """Show a line below the choice of pictures."""
        if self._status.content != text:
            self._status.content = text

    def _change(self, change: Callable[[Playback], Playback]) -> Playback:
        """Change the playback; return what it was."""
        with self._lock:
            before, self._playback = self._playback, change(self._playback)
        return before

    def _time_set(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is None:  # set by this program
            return
        self._change(lambda now: replace(now, time=float(self._time.value)))
        self._changed()

    def _play_pressed(self, _: object) -> None:
        self._change(lambda now: replace(now, playing=False) if now.playing else now.started())
        self._label()
        self._changed()

    def _pace_set(self, _: object) -> None:
        loop, speed = bool(self._loop.value), float(self._speed.value)
        self._change(lambda now: replace(now, loop=loop, speed=speed))

    def _label(self) -> None:
        playing = self._playback.playing
        if self._play.label != ("Pause" if playing else "Play"):
            self._play.label = "Pause" if playing else "Play"
            self._play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY
