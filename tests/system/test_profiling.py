"""Who measures gets each part's own time; who does not pays next to nothing."""

from __future__ import annotations

import time
from typing import get_args

import pytest
import torch
from lightning import Trainer

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.schedules import DeformationSchedule
from devrf.system.profiling import OVERHEAD, Part, measured, measuring, span, tally

CPU = torch.device("cpu")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time in seconds, to be set."""
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    return now


def test_a_part_inside_another_counts_for_itself_alone(clock: list[float]) -> None:
    with measuring(CPU) as watch:
        clock[0] += 1  # overhead
        with span("losses"):
            clock[0] += 2
            with span("warp"):
                clock[0] += 4
            clock[0] += 8
        clock[0] += 16  # overhead
        with span("warp"):
            clock[0] += 32
    clock[0] += 64
    assert watch.seconds() == {OVERHEAD: 17, "losses": 10, "warp": 36}


def test_a_part_that_fails_has_ended_all_the_same(clock: list[float]) -> None:
    with measuring(CPU) as watch:
        with pytest.raises(ZeroDivisionError), span("decoder"):
            clock[0] += 1
            raise ZeroDivisionError
        clock[0] += 2
    assert watch.seconds() == {"decoder": 1, OVERHEAD: 2}


def test_counts_add_up_and_may_be_tensors() -> None:
    tally("heavy", 7)  # nobody listens
    with measuring(CPU) as watch:
        tally("heavy", 2)
        tally("heavy", torch.tensor(3))
        tally("tested", 10)
    assert watch.counts == {"heavy": 5, "tested": 10}


def test_nothing_is_kept_when_nobody_measures() -> None:
    assert not measured()
    assert span("warp") is span("density")
    with measuring(CPU):
        assert measured()
    assert not measured()


def test_training_does_every_part(
    rest: LoadedCheckpoint, datamodule: SceneDataModule, trainer: type[Trainer]
) -> None:
    schedule = DeformationSchedule(sides=(4,), iterations_per_frame=(2,), rays=64)
    with measuring(CPU) as watch:
        trainer(max_steps=4).fit(DeformationStage(rest, schedule), datamodule=datamodule)
    assert set(watch.seconds()) == {*get_args(Part), OVERHEAD}
    counts = [int(watch.counts[name]) for name in ("tested", "opaque", "reached", "heavy")]
    assert counts == sorted(counts, reverse=True) and counts[-1] > 0
