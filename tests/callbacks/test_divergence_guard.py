"""Divergence is rolled back once, then ends the stage; a sound stage is not touched."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer
from torch import Tensor

from devrf.callbacks import DivergenceGuard, PeriodicCheckpoint, TrainingRecord
from devrf.callbacks.divergence_guard import collapsed_to_empty, collapsed_to_opaque
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.checkpoints.checkpoint_file import read_checkpoint_file
from devrf.errors import DevrfError
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level, Visits
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import CanonicalRates

# Three frames. Level 0: frame 1 in 0–11, frame 2 in 12–17; level 1: 18–25 and 26–29.
MOVING = DeformationSchedule(levels=(Level(4, 6), Level(6, 4)), rays=64)
# A phase of the canonical stage from 0 to 9, one from 10 to 23; and longer ones.
SHORT: dict[str, Any] = {"iterations": 24, "upsample_at": (10,), "decay_iterations": 100}
LONG: dict[str, Any] = {**SHORT, "iterations": 50, "upsample_at": (10,), "rays": 128}


@pytest.fixture(autouse=True)
def warnings_of_devrf(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, logger="devrf")


@pytest.fixture
def moving(rest: LoadedCheckpoint) -> Callable[[], DeformationStage]:
    """``moving()``: a deformation stage of the tiny scene."""
    return lambda: DeformationStage(copy.deepcopy(rest), MOVING, iterations_per_step=1)


class Spoil(Callback):
    """Spoils a parameter or gradient once at each of some iterations."""

    def __init__(self, what: str, *iterations: int, group: int = 0) -> None:
        self.what = what
        self.group = group
        self.iterations = list(iterations)
        self.rates: list[tuple[int, float]] = []
        self.drawn: list[tuple[int, Tensor]] = []

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: Any, optimizer: Any) -> None:
        self.rates.append((pl_module.position.iteration, optimizer.param_groups[0]["lr"]))
        if pl_module.position.iteration in self.iterations:
            self.iterations.remove(pl_module.position.iteration)
            value = optimizer.param_groups[self.group]["params"][0]
            with torch.no_grad():
                if self.what == "gradient":
                    value.grad.view(-1)[5] = math.nan
                else:
                    value.fill_(float(self.what))

    def on_train_batch_start(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
        self.drawn.append((pl_module.position.iteration, pl_module.generator.get_state()))


def finite(state: dict[str, Any]) -> bool:
    values = [v for v in state.values() if isinstance(v, Tensor) and v.is_floating_point()]
    return all(bool(torch.isfinite(v).all()) for v in values)


@pytest.mark.parametrize("what", ["gradient", "inf"])
def test_the_first_time_is_rolled_back(fit, canonical, caplog, what):
    spoil, guard = Spoil(what, 14), DivergenceGuard(every_iterations=4)
    stage = fit(canonical(**SHORT), TrainingRecord(), spoil, guard)
    assert finite(stage.state_dict())
    at = stage.position
    assert (at.iteration, at.num_rollbacks, at.lr_scale) == (24, 1, 0.5)
    assert stage.provenance.record["num_rollbacks"] == 1
    (said,) = caplog.messages
    # Checked after 18 iterations, or where the phase ended: the phase is learned again.
    assert said.startswith("canonical: ")
    assert " of 24 (13x8x13): back to iteration 10, learning rates at 0.5" in said
    rates = [rate for iteration, rate in spoil.rates if iteration == 10]
    assert rates[1] == pytest.approx(rates[0] / 2)
    first, again = (state for iteration, state in spoil.drawn if iteration == 10)
    assert not torch.equal(first, again)


def test_the_second_time_ends_the_stage_in_its_last_good_state(fit, canonical, tmp_path):
    saving = PeriodicCheckpoint(tmp_path, every_seconds=0, share=1.0)
    spoil, guard = Spoil("nan", 3, 14, group=1), DivergenceGuard(every_iterations=4)
    with pytest.raises(DevrfError) as caught:
        fit(canonical(**SHORT), spoil, guard, saving)
    said = str(caught.value)
    # Checked before a file is written, after every iteration.
    assert said.startswith("canonical stage: values of color are not finite by iteration 15 of 24")
    for part in (
        "again after learning rates were cut to 0.5",
        "what it was at iteration 10 is kept",
        "lower schedule.rates or the weights of loss.fine",
    ):
        assert part in said
    newest = tmp_path / "canonical-progress-10.ckpt"
    assert newest in set(tmp_path.iterdir())
    for path in tmp_path.iterdir():
        assert finite(read_checkpoint_file(path)["state_dict"])
    # A stage that goes on from there remembers.
    again = fit(canonical(**SHORT), DivergenceGuard(), ckpt_path=newest)
    at = again.position
    assert (at.iteration, at.num_rollbacks, at.lr_scale) == (24, 2, 0.25)


def test_a_frame_is_visited_again(fit, moving, caplog):
    stage = fit(moving(), Spoil("nan", 21), DivergenceGuard())
    phase = Visits(MOVING, 3).phase(21)
    assert f"(frame {phase.frame}, " in caplog.text
    assert f"back to iteration {phase.start}," in caplog.text
    assert (stage.position.iteration, stage.position.num_rollbacks) == (30, 1)
    assert finite(stage.state_dict())


@pytest.mark.parametrize(
    ("density", "words", "carve"), [("-100", "empty", True), ("100", "opaque", False)]
)
def test_a_field_that_empties_or_fills_is_rolled_back(
    fit, canonical, caplog, density, words, carve
):
    guard = DivergenceGuard(every_iterations=20)
    stage = fit(canonical(**LONG, visual_hull_init=carve), Spoil(density, 30), guard)
    assert f"everything has become {words} by iteration" in caplog.text
    assert "data.background" in caplog.text and "data.box" in caplog.text
    assert stage.position.num_rollbacks == 1 and stage.position.iteration == 50


def test_an_occupancy_that_a_diverged_field_has_narrowed_comes_back(fit, canonical):
    masks: list[tuple[int, Tensor]] = []

    class HalfGone(Callback):
        def on_train_batch_start(self, trainer: Trainer, stage: Any, *_: Any) -> None:
            masks.append((stage.position.iteration, stage.scene_model.occupancy.mask))
            if stage.position.iteration == 14 and not stage.position.num_rollbacks:
                values = stage.scene_model.canonical.density.values.data
                values[: len(values) // 2] = -100.0
                values[0, 0, 0] = math.inf

    # The occupancy is renewed at 14 and later; the field is looked at where the phase ends.
    stage = fit(canonical(**SHORT, occupancy_every=4), HalfGone(), DivergenceGuard(50))
    assert stage.position.num_rollbacks == 1
    assert [n for n, _ in masks] == [*range(24), *range(10, 24)]
    assert masks[20][1].sum() < 0.7 * masks[10][1].sum()
    assert torch.equal(masks[24][1], masks[10][1]) and masks[34][1].sum() > masks[20][1].sum()
    # Where nothing is left the guard still has its say, not the pixels that meet nothing.
    stage = fit(canonical(**LONG, occupancy_every=4), Spoil("-100", 30), DivergenceGuard(20))
    assert stage.position.num_rollbacks == 1 and stage.position.iteration == 50


def test_a_stage_that_never_saw_anything_warns(fit, canonical, caplog):
    clear = {"alpha_init": 1e-7, "rates": CanonicalRates(density=1e-9)}
    guard = DivergenceGuard(every_iterations=20)
    stage = fit(canonical(**{**SHORT, "upsample_at": ()}, **clear), guard)
    assert "canonical: nothing is to be seen at the end (is data.background" in caplog.text
    assert (stage.position.iteration, stage.position.num_rollbacks) == (24, 0)
    # With a second phase there is nothing to draw pixels from.
    with pytest.raises(DevrfError, match="empty by iteration 10: check data.background"):
        fit(canonical(**SHORT, **clear), guard)


def test_a_sound_stage_is_not_touched(fit, canonical, moving, caplog):
    def learned(*callbacks: Callback) -> list[dict[str, Any]]:
        stages = [canonical(**SHORT), moving()]
        torch.manual_seed(4)
        return [fit(stage, *callbacks).state_dict() for stage in stages]

    watched, alone = learned(DivergenceGuard(every_iterations=3)), learned()
    assert caplog.messages == []
    for one, other in zip(watched, alone, strict=True):
        for name, value in one.items():
            if isinstance(value, Tensor):
                assert torch.equal(value, other[name]), name


def test_senseless_settings_are_refused():
    with pytest.raises(DevrfError, match="callbacks.divergence_guard: expected"):
        DivergenceGuard(10, 1.5)


def test_emptied_and_filled_by_hand():
    assert collapsed_to_empty(opacity=0.001, highest=0.2, expected=0.3)
    assert not collapsed_to_empty(0.02, 0.2, 0.3)  # faint, but there
    assert not collapsed_to_empty(0.001, 0.02, 0.3)  # it has never been there
    assert not collapsed_to_empty(0.0, 0.2, 0.01)  # nothing should be there
    assert collapsed_to_opaque(opacity=0.7, lowest=0.2, expected=0.2)
    assert not collapsed_to_opaque(0.5, 0.2, 0.2)  # three fifths of the light still pass
    assert not collapsed_to_opaque(0.7, 0.5, 0.2)  # it never passed: fog, at the beginning
    assert not collapsed_to_opaque(1.0, 0.1, 0.99)  # no light should pass
