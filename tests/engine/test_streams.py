"""Streams wait for each other; frames learned in parallel learn what they learn alone."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.callbacks import LambdaCallback
from torch.profiler import ProfilerActivity, profile

from devrf.data.batch import Pixels
from devrf.engine.learner import ParallelBatch
from devrf.methods.devrf.deformation_schedule import DeformationPhase, DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import MotionSettings
from devrf.system.streams import StreamParallel

GPU, CPU = torch.device("cuda"), torch.device("cpu")


@dataclass
class Stream:
    """A stand-in for a CUDA stream."""

    name: str
    noted: list[str]

    def wait_stream(self, other: Stream) -> None:
        self.noted.append(f"{self.name} waits for {other.name}")


class Streams:
    """A stand-in for CUDA's streams: records which waits for which, and where pieces run."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.noted: list[str] = []
        self.made = 0
        self.present = Stream("present", self.noted)
        monkeypatch.setattr(torch.cuda, "current_stream", lambda device: self.present)
        monkeypatch.setattr(torch.cuda, "Stream", self.make)
        monkeypatch.setattr(torch.cuda, "stream", self.on)

    def make(self, device: torch.device) -> Stream:
        self.made += 1
        return Stream(f"stream {self.made}", self.noted)

    @contextmanager
    def on(self, stream: Stream) -> Iterator[None]:
        usual, self.present = self.present, stream
        yield
        self.present = usual

    def piece(self, name: str) -> Callable[[], str]:
        def work() -> str:
            self.noted.append(f"{name} on {self.present.name}")
            return name

        return work


@pytest.fixture
def streams(monkeypatch: pytest.MonkeyPatch) -> Streams:
    return Streams(monkeypatch)


def test_streams_fork_before_the_first_piece_and_join_after_the_last(streams):
    parallel = StreamParallel()
    expected = [
        "stream 1 waits for present",
        "stream 2 waits for present",
        "a on present",
        "b on stream 1",
        "c on stream 2",
        "present waits for stream 1",
        "present waits for stream 2",
    ]
    assert parallel([streams.piece(name) for name in "abc"], GPU) == ["a", "b", "c"]
    assert streams.noted == expected


def test_on_a_cpu_and_under_a_profiler_pieces_run_one_by_one(streams):
    def pieces(count: int) -> list[Callable[[], str]]:
        return [streams.piece(str(k)) for k in range(count)]

    StreamParallel()(pieces(3), CPU)
    with profile(activities=[ProfilerActivity.CPU]):
        StreamParallel()(pieces(2), GPU)
    assert streams.noted == [f"{k} on present" for k in (0, 1, 2, 0, 1)]


@dataclass(frozen=True)
class Alone(DeformationSchedule):
    """Learns one frame alone where it would be learned in parallel with another."""

    frame: int = 0

    def phase(self, iteration: int, frames: int) -> DeformationPhase:
        phase = super().phase(iteration, frames)
        return replace(phase, frames=(self.frame,)) if self.frame in phase.frames else phase


# Of four frames number 2 first, then 1 and 3.
TOGETHER = Alone(levels=(Level(5, 4, parallel_frames=2),), rays=64, coarse_to_fine=False)


def test_a_frame_learns_in_parallel_what_it_learns_alone(rest, four_frames, trainer):
    motion = MotionSettings(
        learning_rate=3e-3, unit="box", views="all", pixels="occupied", occupancy_every=3
    )
    drawn: dict[tuple[int, int], Pixels] = {}

    def learn(schedule: Alone) -> DeformationStage:
        stage = DeformationStage(copy.deepcopy(rest), schedule, motion, iterations_per_step=3)
        usual = stage.draw

        def draw(batch: ParallelBatch) -> Pixels:
            place = (stage.active[batch.number].number, stage.iteration)
            if not schedule.frame:
                drawn[place] = usual(batch)
            return drawn[place]

        stage.draw = draw  # type: ignore[method-assign]
        trainer(max_epochs=1).fit(stage, datamodule=four_frames)
        return stage

    both = learn(TOGETHER)
    assert both.iteration == 8 and not torch.equal(drawn[1, 4].flat, drawn[3, 4].flat)
    alone = learn(replace(TOGETHER, frame=3))
    for name in ("to_canonical", "to_time"):
        learned, expected = getattr(both.field, name), getattr(alone.field, name)
        assert learned[3].any() and torch.equal(learned[3], expected[3])
        assert learned[1].any() and not expected[1].any()


def test_each_frame_has_a_copy_of_the_frame_before_it(rest, four_frames, trainer):
    schedule = DeformationSchedule(levels=(Level(4, 2), Level(5, 1, parallel_frames=2)), rays=64)
    stage, visited = DeformationStage(rest, schedule), []

    def look(trainer: Trainer, stage: DeformationStage, *_: Any) -> None:
        visit = (stage.phase.level, *(frame.number for frame in stage.active))
        if visited[-1:] != [visit]:
            visited.append(visit)
        for frame in stage.active:
            neighbour = stage.field.to_time[frame.number - 1]
            assert torch.equal(frame.before, neighbour)
            assert bool(neighbour.any()) == (frame.number > 1)

    watch = LambdaCallback(on_train_batch_start=look)
    trainer(watch, max_epochs=1).fit(stage, datamodule=four_frames)
    # One by one; then in two phases: frame 2 alone, frames 1 and 3 in parallel.
    assert visited == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 1, 3)]
    assert stage.iteration == stage.total_iterations == 8 + 2
