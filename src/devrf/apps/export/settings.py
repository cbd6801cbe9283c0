"""What ``stage=export`` writes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from devrf.errors import DevrfError
from devrf.geometry.clock import FrameClock

Format = Literal["gltf", "ply", "obj", "usd"]
Up = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]


@dataclass(frozen=True)
class ExportSettings:
    """The geometry that ``stage=export`` writes.

    Attributes:
        format: ``gltf`` (one .glb file that plays), ``usd`` (one file with time samples), ``ply``
            or ``obj`` (a file a time).
        content: ``surface``, one mesh that moves; ``points``, coloured points of each time;
            ``auto`` takes the surface of a method that has one and knows where its points go.
        threshold: opacity of one voxel, in (0, 1): the surface is where the field reaches it.
        side: points of the sampled grid along the longest edge; None: those of the field.
        faces: triangles to keep at most.
        pieces: connected pieces with a smaller share of the largest one's faces are left out.
        reach: how many times as far from the cameras as half of the surface a vertex may be.
        colors: of a vertex: seen along its normal (``normal``), or the mean over directions from
            which it can be seen (``mean``).
        points: number of points at each time, at most.
        times: times in [0, 1], ascending; None: the training frames', or as ``fps`` says.
        fps: evenly spread times, so many a second; None: ``times``.
        seconds: how long time 0 to 1 takes.
        up: the axis of the capture's world that points up; ``auto``: the one nearest to the
            cameras' mean.
        metres: length of a unit of the capture's world.
        into: the folder; None: ``export`` in the run's.
    """

    format: Format = "gltf"
    content: Literal["auto", "surface", "points"] = "auto"
    threshold: float = 0.1
    side: int | None = None
    faces: int = 20_000
    pieces: float = 0.01
    reach: float = 10.0
    colors: Literal["normal", "mean"] = "mean"
    points: int = 20_000
    times: Sequence[float] | None = None
    fps: float | None = None
    seconds: float = 3.0
    up: Up = "auto"
    metres: float = 1.0
    into: str | Path | None = None

    def __post_init__(self) -> None:
        if not 0 < self.threshold < 1:
            raise DevrfError(f"export.threshold: expected between 0 and 1, not {self.threshold}")
        if self.side is not None and not 2 <= self.side <= 1024:
            raise DevrfError(f"export.side: expected 2 to 1024, not {self.side}")
        for name, least in (("faces", 4), ("points", 1)):
            if getattr(self, name) < least:
                raise DevrfError(f"export.{name}: expected at least {least}")
        if not 0 <= self.pieces <= 1:
            raise DevrfError(f"export.pieces: expected 0 to 1, not {self.pieces}")
        for name in ("reach", "fps", "seconds", "metres"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise DevrfError(f"export.{name}: expected more than 0, not {value}")
        self._check_times()

    def _check_times(self) -> None:
        if self.times is None:
            return
        if self.fps is not None:
            raise DevrfError("export.times: export.fps also says which times; give one of them")
        pairs = zip(self.times, list(self.times)[1:], strict=False)
        if not self.times or not all(a < b for a, b in pairs):
            raise DevrfError("export.times: expected ascending times, such as [0,0.5,1]")
        if not (0 <= self.times[0] and self.times[-1] <= 1):
            raise DevrfError(f"export.times: expected times from 0 to 1, not {list(self.times)}")

    def moments(self, clock: FrameClock) -> tuple[float, ...]:
        """The times to export, of a scene whose training frames have the clock's times."""
        if self.times is not None:
            return tuple(self.times)
        if self.fps is not None:
            steps = max(1, round(self.seconds * self.fps))
            return tuple(k / steps for k in range(steps + 1))
        return clock.times
