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
# Steps of almost three hours at 100 frames a second.
MOST_STEPS = 2**22
# So many standard deviations above chance is an offset. At its best of all lags unrelated motion
# comes to 3.5 one time in twenty, and to 4 one time in a hundred.
SURE = 4.0
# Of fewer independent values nothing is concluded: all rising pieces of smooth motion are alike.
LEAST_VALUES = 6
# Another lag that is as sure as this share of the best may be the right one as well.
RIVAL = 0.8
# What must not be 0, or 1, is so far from it.
TINY = 1e-9

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
        found = offset_between(surveys[0], survey)
        if found.sureness < SURE:
            raise DevrfError(
                f"{path}: what moves in it does not tell when it began ({found.sureness:.1f} "
                f"standard deviations above chance beside {paths[0]}, expected {SURE} or more); "
                f"{_BY_HAND}"
            )
        if found.rival is not None:
            raise DevrfError(
                f"{path}: what moves in it repeats: it began {found.seconds:+.2f} or "
                f"{found.rival:+.2f} s after {paths[0]}; {_BY_HAND}"
            )
        log.info(
            "%s: began %+.3f s after %s (correlation %.2f, %.1f standard deviations above chance)",
            path,
            found.seconds,
            paths[0],
            found.correlation,
            found.sureness,
        )
        offsets.append(found.seconds)
    return offsets


@dataclass(frozen=True)
class Offset:
    """When a video began.

    Attributes:
        seconds: after the first.
        correlation: of the motion in both, at that offset.
        sureness: how far that is above chance, in standard deviations.
        rival: seconds of another offset that is about as sure; None: there is none.
    """

    seconds: float
    correlation: float
    sureness: float
    rival: float | None


def offset_between(first: Survey, second: Survey) -> Offset:
    """When the second video began, from the motion in both.

    The amounts of motion a second, sampled on one clock, are correlated at every lag at which
    they overlap by half of the shorter. Two smooth signals correlate by chance, the more the fewer
    independent values overlap: of n samples of unrelated signals the variance of the correlation r
    is Σ_k ρ_a(k) ρ_b(k) / n with their autocorrelations ρ (Bartlett 1935), so that atanh r has that
    of n' − 3 independent values, n' = n / Σ_k ρ_a(k) ρ_b(k) (Fisher 1915). The lag that is farthest
    above chance is taken, and refined by a parabola. A square root of the motion keeps a part that
    is large in one view from deciding alone.
    """
    step = 1 / (STEPS_A_FRAME * max(first.rate, second.rate))
    a, a_start = _sampled(first, step)
    b, b_start = _sampled(second, step)
    min_overlap = max(2, int(LEAST_OVERLAP * min(len(a), len(b))))
    lags = np.arange(min_overlap - len(b), len(a) - min_overlap + 1)
    correlations, overlaps = _correlations(a, b, lags)
    independent = overlaps / _samples_a_value(a, b)
    sureness = np.arctanh(correlations.clip(TINY - 1, 1 - TINY))
    sureness *= np.where(independent < LEAST_VALUES, 0.0, np.sqrt((independent - 3).clip(min=0)))
    best = int(sureness.argmax())
    seconds = lags * step + a_start - b_start
    # A peak ends where it is half as high.
    low = np.flatnonzero(sureness[:best] < sureness[best] / 2)
    high = np.flatnonzero(sureness[best:] < sureness[best] / 2)
    elsewhere = sureness.copy()
    elsewhere[low[-1] if len(low) else 0 : best + high[0] if len(high) else None] = -np.inf
    rival = int(elsewhere.argmax())
    shift = 0.0
    if 0 < best < len(sureness) - 1:
        left, middle, right = sureness[best - 1 : best + 2]
        bend = left - 2 * middle + right
        shift = 0.5 * (left - right) / bend * step if bend < 0 else 0.0
    return Offset(
        seconds=float(seconds[best] + shift),
        correlation=float(correlations[best]),
        sureness=float(sureness[best]),
        rival=float(seconds[rival]) if elsewhere[rival] > RIVAL * sureness[best] else None,
    )


def _sampled(survey: Survey, step: float) -> tuple[Signal, float]:
    """Motion a second, square root, every ``step`` seconds, and the time of its first sample."""
    times = np.array(survey.times)
    middles = (times[1:] + times[:-1]) / 2
    speed = np.sqrt(np.array(survey.motion[1:]) / np.diff(times))
    count = max(2, int((middles[-1] - middles[0]) / step) + 1)
    clock = middles[0] + step * np.arange(count)
    return np.interp(clock, middles, speed), float(middles[0])


def _correlations(
    a: Signal, b: Signal, lags: npt.NDArray[np.int_]
) -> tuple[Signal, npt.NDArray[np.int_]]:
    """The correlation of the overlap of two signals, the second moved by each of L lags; samples.

    Where one of them does not change, it is 0.
    """
    a, b = a - a.mean(), b - b.mean()
    low, high = lags.clip(min=0), np.minimum(len(a), len(b) + lags)
    overlap = high - low

    def sums(signal: Signal, begin: npt.NDArray[np.int_]) -> Signal:
        total = np.concatenate([[0.0], signal.cumsum()])
        part: Signal = total[begin + overlap] - total[begin]
        return part

    size = len(a) + len(b)
    products = np.fft.irfft(np.fft.rfft(a, size) * np.fft.rfft(b, size).conj(), size)[lags]
    of_a, of_b = sums(a, low), sums(b, low - lags)
    spread_a = sums(a**2, low) - of_a**2 / overlap
    spread_b = sums(b**2, low - lags) - of_b**2 / overlap
    spread = np.sqrt(spread_a.clip(min=0) * spread_b.clip(min=0))
    changes = spread > TINY * len(a) * a.std() * b.std()
    correlations = np.zeros_like(spread)
    np.divide(products - of_a * of_b / overlap, spread, out=correlations, where=changes)
    return correlations, overlap


def _samples_a_value(a: Signal, b: Signal) -> float:
    """Σ_k ρ_a(k) ρ_b(k): how many samples of unrelated signals count as one."""
    count = min(len(a), len(b))
    both = np.ones(count)
    for signal in (a - a.mean(), b - b.mean()):
        power = np.abs(np.fft.rfft(signal, 2 * len(signal))) ** 2
        products = np.fft.irfft(power, 2 * len(signal))[:count]
        # Beyond its first zero an autocorrelation is mostly noise.
        products *= np.minimum.accumulate(products) > 0
        both *= products / max(products[0], TINY)
    return 1 + 2 * float(both[1:].sum())
