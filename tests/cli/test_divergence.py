"""Divergence, from the command line: rolled back once, reported, then ended."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from devrf.checkpoints.checkpoint_file import read_checkpoint_file
from devrf.ops.adam import GridAdam

ALARMS = ("back to iteration", "everything has become", "nothing is to be seen", "times that of")


@pytest.fixture
def spoil(monkeypatch: pytest.MonkeyPatch):
    """``spoil(*steps)``: the optimiser's n-th steps, from 1 on, leave nothing but NaN."""

    def at(*steps: int) -> None:
        taken, usual = [0], GridAdam.step

        def step(optimizer: GridAdam, closure=None):
            result = usual(optimizer, closure)
            taken[0] += 1
            if taken[0] in steps:
                with torch.no_grad():
                    for group in optimizer.param_groups:
                        for value in group["params"]:
                            value.fill_(float("nan"))
            return result

        monkeypatch.setattr(GridAdam, "step", step)

    return at


def test_a_run_that_was_rolled_back_ends_well_and_says_so(
    devrf, tiny, often, spoil, tmp_path: Path
) -> None:
    # Six iterations of the canonical stage, two of them twice; then the deformation.
    spoil(4, 14)
    outcome = devrf(*tiny, *often, "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    said = [line for line in outcome.out.splitlines() if "back to iteration" in line]
    assert [line.split(":")[0] for line in said] == ["canonical", "deformation"]
    assert "(frame " in said[1]
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["canonical"]["num_rollbacks"] == found["deformation"]["num_rollbacks"] == 1
    assert found["deformation"]["psnr"] > 5


def test_the_second_time_the_run_ends_in_its_last_good_state(
    devrf, tiny, often, spoil, tmp_path: Path
) -> None:
    command = (*tiny, *often, "hydra.run.dir=run")
    spoil(2, 4)
    outcome = devrf(*command)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: canonical stage: ")
    assert "schedule.rates or the weights of loss.fine" in outcome.err
    folder = tmp_path / "run" / "checkpoints"
    left = sorted(path.name for path in folder.iterdir())
    assert all(name.startswith("canonical-progress-") for name in left) and left
    for path in folder.iterdir():
        density = read_checkpoint_file(path)["state_dict"]["scene_model.canonical.density.values"]
        assert bool(torch.isfinite(density).all())
    # The same command goes on from there.
    outcome = devrf(*command, "stage=canonical")
    assert outcome.status == 0 and "canonical: goes on at iteration" in outcome.out


def test_no_alarm_where_all_is_well(trained) -> None:
    assert not [line for line in trained[1].out.splitlines() if any(a in line for a in ALARMS)]
