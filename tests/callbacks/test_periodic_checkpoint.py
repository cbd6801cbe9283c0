"""Progress files: when they are written, how many are kept, and what a full disk does."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lightning import Callback, Trainer
from lightning.pytorch.callbacks import LambdaCallback

from devrf.callbacks import PeriodicCheckpoint, StopOnSignal
from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_stage import CanonicalStage


def at(iteration: int, act: Callable[[], object]) -> Callback:
    """Does something after an iteration, before the callbacks that come later."""

    def act_there(trainer: Any, stage: Any, *_: Any) -> None:
        if stage.position.iteration == iteration:
            act()

    return LambdaCallback(on_train_batch_end=act_there)


@pytest.fixture
def learn(fit, canonical) -> Callable[..., CanonicalStage]:
    """``learn(*callbacks)``: a stage of 12 iterations, each of them a step."""
    return lambda *callbacks, **how: fit(canonical(), *callbacks, **how)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(("seconds", "left"), [(0, [10, 11]), (1000, [])])
def test_the_last_two_are_kept_and_none_is_written_before_its_time(learn, tmp_path, seconds, left):
    saving = PeriodicCheckpoint(tmp_path, seconds, share=1.0)
    learn(saving)
    # The stage's last iteration is its checkpoint's.
    assert names(tmp_path) == [f"canonical-progress-{n}.ckpt" for n in left]
    assert saving.saved == (left[-1] if left else None)


def test_a_full_disk_does_not_end_the_training(learn, tmp_path, monkeypatch, caplog):
    usual = Trainer.save_checkpoint

    def full(trainer: Trainer, path: Path, **how: Any) -> None:
        if 4 <= trainer.lightning_module.position.iteration <= 7:
            raise OSError(28, "No space left on device", str(path))
        usual(trainer, path, **how)

    monkeypatch.setattr(Trainer, "save_checkpoint", full)
    lost: list[list[str]] = []
    with caplog.at_level(logging.WARNING, logger="devrf"):
        watch = at(7, lambda: lost.append(names(tmp_path)))
        stage = learn(PeriodicCheckpoint(tmp_path, every_seconds=0, share=1.0), watch)
    assert stage.position.iteration == 12
    assert lost == [["canonical-progress-2.ckpt", "canonical-progress-3.ckpt"]]
    (said,) = caplog.messages
    assert said.startswith(f"{tmp_path}/canonical-progress-4.ckpt: No space left on device; ")
    assert "the last good progress file stays (iteration 3)" in said
    assert names(tmp_path) == ["canonical-progress-10.ckpt", "canonical-progress-11.ckpt"]


def test_every_process_knows_the_file_that_the_first_has_written(canonical, tmp_path):
    said = SimpleNamespace(broadcast=lambda saved: 7)  # the last that was not lost to a full disk
    trainer: Any = SimpleNamespace(
        is_global_zero=False, callbacks=[], fast_dev_run=False, strategy=said
    )
    saving, stage = PeriodicCheckpoint(tmp_path), canonical()
    stage.position.iteration = 9
    saving.on_train_end(trainer, stage)
    assert saving.saved == 7
    assert "the last is of 7" in saving.left_at(stage)


def test_senseless_times_are_refused(tmp_path):
    with pytest.raises(DevrfError, match="callbacks.checkpoint: expected"):
        PeriodicCheckpoint(tmp_path, -1.0)


@pytest.mark.parametrize(
    ("iteration", "left"),
    [(5, ["canonical-progress-5.ckpt"]), (12, [])],
    ids=["on the way", "after the last iteration"],
)
def test_a_signal_stops_the_stage_saved(learn, tmp_path, iteration, left):
    saving = PeriodicCheckpoint(tmp_path, every_seconds=1000)
    with StopOnSignal(saving) as stop:
        stage = learn(at(iteration, lambda: os.kill(os.getpid(), signal.SIGTERM)), saving, stop)
    assert (stop.number, stage.position.iteration) == (signal.SIGTERM, iteration)
    assert names(tmp_path) == left
