"""The frame clock: the only place where a time becomes frames and weights."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from devrf.geometry.box import constant


@dataclass(frozen=True)
class BetweenFrames:
    """A time between two frames.

    Attributes:
        before: index of the frame at or before the time.
        after: index of the frame after it (``before`` itself on a frame).
        weight: share of ``after``, in [0, 1); 0 exactly on a frame.
    """

    before: int
    after: int
    weight: float


@dataclass(frozen=True)
class FrameClock:
    """The frames' times, in ascending order; frame 0 is at time 0, the canonical state.

    Attributes:
        times: T times in [0, 1]; 0 alone for a static scene.
    """

    times: tuple[float, ...]

    # Times come from JSON text, float32 tensors and k / (T − 1): equal up to rounding only.
    TOLERANCE = 1e-5

    def __post_init__(self) -> None:
        if not self.times or self.times[0] != 0.0:
            raise ValueError("a frame clock begins at time 0")
        if not all(b - a > self.TOLERANCE for a, b in pairwise(self.times)):
            raise ValueError("a frame clock needs distinct ascending times")
        if self.times[-1] > 1 + self.TOLERANCE:
            raise ValueError("a frame clock ends at time 1")

    def __len__(self) -> int:
        return len(self.times)

    @staticmethod
    def from_times(times: Tensor) -> FrameClock:
        """The clock of the distinct values in ``times`` (any shape), with 0 put before them."""
        frames = [0.0]
        for time in sorted(float(t) for t in times.flatten().tolist()):
            if time - frames[-1] > FrameClock.TOLERANCE:
                frames.append(time)
        return FrameClock(tuple(frames))

    def at(self, time: float) -> BetweenFrames:
        """The frames around ``time``; outside the clock's range that is the first or last one."""
        frame = bisect_right(self.times, time, key=lambda t: t - self.TOLERANCE) - 1
        frame = max(frame, 0)
        before = self.times[frame]
        if frame == len(self) - 1 or time <= before + self.TOLERANCE:
            return BetweenFrames(frame, frame, 0.0)
        return BetweenFrames(frame, frame + 1, (time - before) / (self.times[frame + 1] - before))

    def knows(self, time: float) -> bool:
        """Whether ``time`` is that of a frame."""
        return abs(self.times[self.at(time).before] - time) <= self.TOLERANCE

    def frames_of(self, times: Tensor) -> Tensor:
        """The nearest frame of each time: int64, the shape of ``times``."""
        clock = torch.tensor(self.times, dtype=torch.float64, device=times.device)
        middles = (clock[1:] + clock[:-1]) / 2
        return torch.searchsorted(middles, times.double().contiguous())

    def between(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`at`, for many times, without waiting for a device.

        Args:
            times: (...,) of any shape.

        Returns:
            The frames before and after each time, int64, and the share of the one after, all of
            the shape of ``times``.
        """
        clock = constant(self.times, times.dtype, times.device)
        after = torch.searchsorted(clock, times.contiguous() - self.TOLERANCE)
        after = after.clamp(max=len(self) - 1)
        on_frame = (clock[after] - times).abs() <= self.TOLERANCE
        before = torch.where(on_frame | (times > clock[-1]), after, (after - 1).clamp(min=0))
        gap = clock[after] - clock[before]
        alone = gap <= 0
        return before, after, torch.where(alone, 0, (times - clock[before]) / gap.where(~alone, 1))
