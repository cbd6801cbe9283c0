"""The time that the page shows, while it runs and while it stands."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
