"""Videos aligned in time: offsets of their clocks, and frames of the same time."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devrf.apps.capture.survey import Survey
from devrf.errors import DevrfError

log = logging.getLogger(__name__)

# Signals are compared in steps of a quarter of a frame, in windows of at least half the shorter.
STEPS_A_FRAME = 4
LEAST_OVERLAP = 0.5
# Steps of 40 minutes at 100 frames a second: the time that comparing takes goes with their square.
MOST_STEPS = 2**20
# Correlation of two views of one motion is above this; of unrelated motion it is rarely.
SURE = 0.5

_BY_HAND = (
    "give capture.offsets=[0, seconds that each further video began after the first, ...], or "
    "clap once in sight of all cameras"
)

Signal = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Timeline:
    """Times that all fixed views show.

    Attributes:
        times: T times in [0, 1], ascending, the first 0 and the last 1.
        positions: V tuples of T positions, the frame of each video nearest to each time.
    """

    times: tuple[float, ...]
    positions: tuple[tuple[int, ...], ...]


def timeline(
    paths: Sequence[Path],
    surveys: Sequence[Survey],
    max_timesteps: int,
    offsets: Sequence[float] | None = None,
) -> Timeline:
    """Align the videos of the fixed views, ``offsets`` seconds after the first, or as they move.

    The times are those of the frames of the video with the lowest rate, every n-th if it has more
    of them than ``max_timesteps``. The other videos give the frames nearest to these times.

    Raises:
        DevrfError: the offsets cannot be found, or the videos have too little time in common.
    """
    begun = list(map(float, offsets)) if offsets is not None else offsets_found(paths, surveys)
    clocks = [begin + np.array(s.times) for begin, s in zip(begun, surveys, strict=True)]
    first = np.array([clock[0] for clock in clocks])
    last = np.array([clock[-1] for clock in clocks])
    start = first.max()
    end = last.min()
    shortest = (last - first).min()
    longest = (last - first).max()
    if end - start < LEAST_OVERLAP * shortest:
        late = paths[int(first.argmax())]
        raise DevrfError(
            f"{late}: all {len(paths)} videos together show {max(end - start, 0):.2f} s, of "
            f"{shortest:.2f} to {longest:.2f} s each; cut them to the same part, or correct "
            "capture.offsets"
        )
    if end - start < 0.95 * longest:
        log.info(
            "videos of different lengths: %.2f to %.2f s; the %.2f s that all show are used",
            shortest,
            longest,
            end - start,
        )
    slowest = int(np.argmin([survey.rate for survey in surveys]))
    slack = 0.5 / surveys[slowest].rate
    clock = clocks[slowest]
    usable = np.flatnonzero((clock >= start - slack) & (clock <= end + slack))
    usable = usable[:: -(-len(usable) // max_timesteps)]
    if len(usable) < 2:
        raise DevrfError(
            f"{paths[slowest]}: {len(usable)} frames in the time that all videos show, expected "
            "at least 2; give longer videos"
        )
    instants = clock[usable]
    # An instant's nearest frame is the last whose midpoint to the frame before it has passed.
    middles = [(other[1:] + other[:-1]) / 2 for other in clocks]
    positions = tuple(
        tuple(np.searchsorted(middle, instants, "right").tolist()) for middle in middles
    )
    scaled = (instants - instants[0]) / (instants[-1] - instants[0])
    return Timeline(tuple(scaled.tolist()), positions)


def offsets_found(paths: Sequence[Path], surveys: Sequence[Survey]) -> list[float]:
    """Seconds that each video began after the first, from the motion in them.

    Raises:
        DevrfError: nothing moves in a video, or it moves unlike in the first.
    """
    for path, survey in zip(paths, surveys, strict=True):
        if max(survey.motion) == 0:
            raise DevrfError(f"{path}: nothing moves in it; {_BY_HAND}")
        if survey.times[-1] * max(s.rate for s in surveys) * STEPS_A_FRAME > MOST_STEPS:
            raise DevrfError(
                f"{path}: {survey.times[-1]:.0f} s of it are too many to compare; {_BY_HAND}"
            )
    offsets = [0.0]
    for path, survey in zip(paths[1:], surveys[1:], strict=True):
        offset, correlation = offset_between(surveys[0], survey)
        log.info(
            "%s: began %+.3f s after %s (correlation %.2f)", path, offset, paths[0], correlation
        )
        if correlation < SURE:
            raise DevrfError(
                f"{path}: what moves in it does not tell when it began (correlation with "
                f"{paths[0]} {correlation:.2f}, expected {SURE} or more); {_BY_HAND}"
            )
        offsets.append(offset)
    return offsets


def offset_between(first: Survey, second: Survey) -> tuple[float, float]:
    """Seconds that the second video began after the first, and the correlation there.

    The amounts of motion a second, sampled on one clock, are correlated at every lag at which
    they overlap by half of the shorter; the peak is refined by a parabola. A square root keeps a
    part that is large in one view from deciding alone.
    """
    step = 1 / (STEPS_A_FRAME * max(first.rate, second.rate))
    a, a_start = _sampled(first, step)
    b, b_start = _sampled(second, step)
    min_overlap = max(2, int(LEAST_OVERLAP * min(len(a), len(b))))
    lags = np.arange(min_overlap - len(b), len(a) - min_overlap + 1)
    values = np.array([_correlation(a, b, int(lag)) for lag in lags])
    best = int(values.argmax())
    lag = float(lags[best])
    if 0 < best < len(values) - 1:
        left, middle, right = values[best - 1 : best + 2]
        bend = left - 2 * middle + right
        lag += 0.5 * (left - right) / bend if bend < 0 else 0.0
    return lag * step + a_start - b_start, float(values[best])


def _sampled(survey: Survey, step: float) -> tuple[Signal, float]:
    """Motion a second, square root, every ``step`` seconds, and the time of its first sample."""
    times = np.array(survey.times)
    middles = (times[1:] + times[:-1]) / 2
    speed = np.sqrt(np.array(survey.motion[1:]) / np.diff(times))
    count = max(2, int((middles[-1] - middles[0]) / step) + 1)
    clock = middles[0] + step * np.arange(count)
    return np.interp(clock, middles, speed), float(middles[0])


def _correlation(a: Signal, b: Signal, lag: int) -> float:
    """The correlation of the overlap of two signals, the second moved by ``lag`` samples."""
    low = max(0, lag)
    high = min(len(a), len(b) + lag)
    a = a[low:high]
    b = b[low - lag : high - lag]
    return float(np.corrcoef(a, b)[0, 1]) if a.std() * b.std() > 0 else -1.0
