"""Small footage, made here."""

from __future__ import annotations

import numpy as np
import pytest

from devrf.apps.capture.survey import Survey
from devrf.pictures.video_file import write_pictures


@pytest.fixture
def film(tmp_path):
    """Writes pictures (H, W, 3) uint8 as a video in the test's folder; returns its path."""

    def write(name, pictures, rate=10):
        write_pictures(tmp_path / name, iter(pictures), rate)
        return tmp_path / name

    return write


@pytest.fixture
def surveyed():
    """A survey of a video of given rate and length, whose motion follows a function of time."""

    def make(motion, rate, seconds, begin=0.0):
        times = np.arange(int(seconds * rate)) / rate
        middles = begin + (times[1:] + times[:-1]) / 2
        amount = [0.0, *(motion(middles) / rate).tolist()]
        return Survey((64, 48), tuple(times.tolist()), (1.0,) * len(times), tuple(amount))

    return make


@pytest.fixture
def textured():
    """(48, 64, 3) uint8 of random patches, another for each seed."""

    def make(seed):
        coarse = np.random.default_rng(seed).integers(0, 256, (24, 32, 3), dtype=np.uint8)
        return coarse.repeat(2, axis=0).repeat(2, axis=1)

    return make
