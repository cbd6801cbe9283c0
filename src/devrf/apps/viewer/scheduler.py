"""Which picture is rendered next: a coarse one at once, finer ones while nothing moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from typing import Protocol

from devrf.apps.viewer.drawing import Picture, Shot

# A finer picture has at most so many times the rows of the one before.
FINER = 3
# Nearly full is made full at once.
NEARLY = 0.75


class Draws(Protocol):
    """What renders: a :class:`~devrf.apps.viewer.drawing.Drawing`."""

    def height_within(self, seconds: float, aspect: float, height: int) -> int:
        """The rows of a picture that takes about ``seconds``, at most ``height``."""
        ...

    def draw(self, shot: Shot, height: int) -> Iterator[Picture | None]:
        """Render a shot: None as often as it could be given up, then the picture."""
        ...


@dataclass
class _Asked:
    """What one viewer wants, and how far it has come.

    Attributes:
        shot: the newest one.
        number: counts the shots of all viewers, in order.
        rows: of the last picture of it that was shown; 0 before the first.
    """

    shot: Shot
    number: int
    rows: int = 0


class RenderScheduler:
    """Renders the newest shot of each viewer, coarse first; a finer picture ends when one moves.

    Shots may be asked for from any thread; pictures are rendered by the one that calls
    :meth:`render_next`. A coarse picture is always finished: while a camera moves without pause
    it would never be seen otherwise.
    """

    def __init__(
        self,
        drawing: Draws,
        show: Callable[[Hashable, Shot, Picture], None],
        *,
        height: int,
        move_seconds: float,
        stop: threading.Event | None = None,
    ) -> None:
        """Begin with nothing to render.

        Args:
            drawing: renders.
            show: takes each picture, with the viewer's key.
            height: rows of a full picture.
            move_seconds: about what a first picture may take.
            stop: once set, the present picture is given up, coarse or not.
        """
        self._stop = stop or threading.Event()
        self.drawing = drawing
        self._show, self._height, self._move_seconds = show, height, move_seconds
        self._asked: dict[Hashable, _Asked] = {}
        self._number = 0
        self._change = threading.Condition()

    def ask(self, key: Hashable, shot: Shot) -> None:
        """Render ``shot`` for the viewer ``key``, instead of what it asked for before."""
        with self._change:
            self._number += 1
            self._asked[key] = _Asked(shot, self._number)
            self._change.notify()

    def again(self) -> None:
        """Render what every viewer asked for anew: the scene has changed."""
        with self._change:
            for one in self._asked.values():
                one.rows = 0
            self._change.notify()

    def drop(self, key: Hashable) -> None:
        """Forget a viewer."""
        with self._change:
            self._asked.pop(key, None)

    @property
    def watched(self) -> bool:
        """Whether anyone has asked for anything."""
        return bool(self._asked)

    def render_next(self, timeout: float) -> bool:
        """Render the most urgent picture, and show it.

        Args:
            timeout: seconds to wait for something to render.

        Returns:
            Whether a picture was shown.
        """
        until = time.monotonic() + timeout
        with self._change:
            while (found := self._most_urgent()) is None:
                left = until - time.monotonic()
                if left <= 0 or not self._change.wait(left):
                    return False
        key, asked = found
        rows, coarse = self._next_rows(asked), asked.rows == 0
        for picture in self.drawing.draw(asked.shot, rows):
            if picture is None:
                if self._stop.is_set() or (not coarse and self._overtaken(key, asked)):
                    return False
                continue
            with self._change:
                present = key in self._asked
                asked.rows = rows
            if present:
                self._show(key, asked.shot, picture)
            return present
        return False

    def _most_urgent(self) -> tuple[Hashable, _Asked] | None:
        """The viewer whose picture is the coarsest; of several the one that has waited longest."""
        waiting = [(k, one) for k, one in self._asked.items() if one.rows < self._height]
        return min(waiting, key=lambda item: (item[1].rows, item[1].number), default=None)

    def _next_rows(self, asked: _Asked) -> int:
        if asked.rows:
            rows = asked.rows * FINER
        else:
            aspect = asked.shot.pose.aspect
            rows = self.drawing.height_within(self._move_seconds, aspect, self._height)
        return self._height if rows > NEARLY * self._height else rows

    def _overtaken(self, key: Hashable, asked: _Asked) -> bool:
        """Whether the viewer has moved on, or another waits for its first picture."""
        with self._change:
            return self._asked.get(key) is not asked or any(
                not one.rows for one in self._asked.values()
            )
