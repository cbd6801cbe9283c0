"""How each frame is fitted in its last visit, and which frames are lost."""

from __future__ import annotations

import logging
import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from devrf.callbacks.frame_fit import FrameFit, complaint, in_ranges, lost
from devrf.engine.position import Position
from devrf.engine.provenance import Provenance
from devrf.engine.schedule import Phase
from devrf.engine.stage import Stage

TRAINER: Any = SimpleNamespace(is_global_zero=True)


class Visiting(Stage):
    """A stage as far as a callback sees it."""

    def __init__(self) -> None:
        self.__dict__["phase"] = None
        self.__dict__["position"] = Position()
        self.__dict__["provenance"] = Provenance(record={"seconds": 1.0})
        self.__dict__["name"] = "deformation"

    iterate = enter = restore = None


Visiting.__abstractmethods__ = frozenset()


def visit(
    fit: FrameFit,
    stage: Stage,
    level: int,
    frame: int | None,
    *errors: float,
    stop: int = 10,
    batches: int = 1,
) -> None:
    """Steps of these errors, and so many batches, in the visit of ``frame`` at a level."""
    stage.__dict__["phase"] = Phase(kind=f"level {level}", start=0, stop=stop, frame=frame)
    for error in errors:
        fit.on_train_batch_start(TRAINER, stage, None, 0)
        stage.position.iterations_done += batches
        fit.on_train_batch_end(TRAINER, stage, {"render": torch.tensor(error)}, None, 0)


def test_a_frame_is_measured_by_the_mean_error_of_its_last_visit(caplog):
    fit, stage = FrameFit(), Visiting()
    fit.setup(TRAINER, stage, "fit")
    fit.on_train_start(TRAINER, stage)
    visit(fit, stage, 1, 1, 0.1, 0.1)
    visit(fit, stage, 1, 2, 0.5)
    visit(fit, stage, 2, 1, 0.003, 0.001)  # backwards would do as well
    visit(fit, stage, 2, 2, 1e-3)
    visit(fit, stage, 2, 3, 0.01)
    assert fit.psnr == {1: pytest.approx(26.9897), 2: pytest.approx(30), 3: pytest.approx(20)}
    with caplog.at_level(logging.WARNING):
        fit.on_train_end(TRAINER, stage)
    assert stage.provenance.record == {
        "seconds": 1.0,
        "lost_frames": 1,
        "frame_psnr": [26.99, 30.0, 20.0],
    }
    said = "frame 3 fits worse than the rest: 20.0 dB, the others 28.5"
    assert caplog.messages == [f"deformation: {said}"]


def test_a_visit_that_was_interrupted_goes_on():
    whole, stage = FrameFit(), Visiting()
    whole.on_train_start(TRAINER, stage)
    visit(whole, stage, 1, 1, 0.1)
    visit(whole, stage, 2, 1, 0.02, 0.01)

    first, second = FrameFit(), FrameFit()
    stage = Visiting()
    first.on_train_start(TRAINER, stage)
    visit(first, stage, 1, 1, 0.1)
    visit(first, stage, 2, 1, 0.02)
    second.setup(TRAINER, stage, "fit")
    second.load_state_dict(first.state_dict())
    second.on_train_start(TRAINER, stage)  # the phase was restored
    visit(second, stage, 2, 1, 0.01)
    assert second.psnr == pytest.approx(whole.psnr) == {1: pytest.approx(18.2391)}


def test_a_visit_that_a_budget_cuts_short_keeps_what_it_had():
    fit, stage = FrameFit(), Visiting()
    visit(fit, stage, 1, 1, 0.02)
    visit(fit, stage, 1, 1, 0.01, stop=7)
    assert fit.psnr == {1: pytest.approx(18.2391)}


def test_what_was_rolled_back_does_not_count():
    fit, stage = FrameFit(), Visiting()
    fit.setup(TRAINER, stage, "fit")
    visit(fit, stage, 1, 1, 0.1, float("nan"))
    stage.position.roll_back(iteration=0, iterations_done=0, lr_scale=0.5)
    visit(fit, stage, 1, 1, 0.01, 0.01)
    assert fit.psnr == {1: pytest.approx(20)}


def test_times_that_are_learned_at_once_have_no_figures():
    fit, stage = FrameFit(), Visiting()
    visit(fit, stage, 1, None, 0.1)
    fit.on_train_end(TRAINER, stage)
    assert fit.psnr == {} and stage.provenance.record == {"seconds": 1.0}


def test_lost_frames_are_four_decibels_below_the_median():
    psnr = {1: 35.0, 2: 30.9, 3: 35.0, 4: 31.1, 5: 36.0}
    assert lost(psnr) == [2]
    assert lost({1: 20.0}) == []


def test_visits_that_met_the_background_alone_are_no_measure(caplog):
    fit, stage = FrameFit(), Visiting()
    for frame, error in enumerate((0.05, 0.0, 1e-9, 0.0), start=1):
        visit(fit, stage, 1, frame, error)
    fit.on_train_end(TRAINER, stage)
    assert stage.provenance.record["frame_psnr"] == [13.01, 60.0, 60.0, 60.0]
    assert stage.provenance.record["lost_frames"] == 0 and not caplog.records
    psnr = {1: 13.0, 2: 60.0, 3: 60.0, 4: 30.0, 5: 32.0}
    assert lost(psnr) == [1] and complaint(psnr, [1]).endswith("13.0 dB, the others 31.0")
    assert lost({1: 60.0}) == []


def test_frames_in_words():
    assert in_ranges([3]) == "3"
    assert in_ranges([1, 2, 5, 20, 21, 22]) == "1 to 2, 5, 20 to 22"
    psnr = {1: 37.0, 2: 25.0, 3: 25.0, 4: 37.0, 5: 37.0}
    said = "frames 2 to 3 fit worse than the rest: 25.0 dB, the others 37.0"
    assert complaint(psnr, lost(psnr)) == said


def test_a_step_of_fewer_batches_counts_less():
    fit, stage = FrameFit(), Visiting()
    fit.on_train_start(TRAINER, stage)
    visit(fit, stage, 1, 1, 0.1, batches=10)
    visit(fit, stage, 1, 1, 0.01, batches=5)
    assert fit.psnr == {1: pytest.approx(-10 * math.log10((10 * 0.1 + 5 * 0.01) / 15))}
