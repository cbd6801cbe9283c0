"""stage=selfcheck: a line for each check, a record, and a status that says whether all held."""

from __future__ import annotations

import json
import multiprocessing
from contextlib import contextmanager

import pytest
import torch

from devrf.selfcheck import runner
from devrf.selfcheck.finding import Finding


@pytest.fixture
def forked(monkeypatch):
    """Processes of checks are forked from this one, which has replaced what they do."""
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("needs fork")

    @contextmanager
    def warm(variables):
        yield multiprocessing.get_context("fork")

    monkeypatch.setattr(runner, "warm_processes", warm)


def test_every_check_has_a_line_and_a_place_in_the_record(devrf, tmp_path):
    outcome = devrf("stage=selfcheck", 'selfcheck.only=[ceilings,"memory in"]', "trainer=cpu")
    assert (outcome.status, outcome.err) == (0, "")
    folder = tmp_path / "outputs" / "selfcheck"
    record = json.loads((folder / "selfcheck.json").read_text())
    assert record["torch"] == torch.__version__
    assert record["device"] and record["devrf"] and "git" in record
    found = [(one["name"], one["verdict"]) for one in record["checks"]]
    assert found == [
        ("ceilings", "held"),
        ("memory in warm-up", "left out"),
        ("memory in capture", "left out"),
    ]
    assert record["checks"][0]["figures"]["bytes_per_second"] > 0
    assert record["checks"][0]["seconds"] > 0
    for one in record["checks"]:
        assert (
            sum(f"{one['verdict']:<8}  {one['name']}: " in x for x in outcome.out.split("\n")) == 1
        )
    assert "1 held, 0 failed, 2 left out" in outcome.out


def test_failed_checks_are_named_and_the_status_is_3(devrf, tmp_path, monkeypatch, forked):
    monkeypatch.setattr(runner, "perform", fail)
    outcome = devrf("stage=selfcheck", "selfcheck.only=[ceilings,frames]", "hydra.run.dir=there")
    assert outcome.status == 3
    assert outcome.err == "devrf: stage=selfcheck: 2 checks failed: ceilings, frames\n"
    record = json.loads((tmp_path / "there" / "selfcheck.json").read_text())
    assert [one["said"] for one in record["checks"]] == ["too slow", "too slow"]


def fail(*_):
    return Finding(False, "too slow")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["selfcheck.only=[celings]"], "not 'celings'; did you mean ceilings?"),
        (["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"], "leave out trainer=ddp"),
    ],
)
def test_what_cannot_be_checked_is_one_line(devrf, tmp_path, arguments, expected):
    outcome = devrf("stage=selfcheck", *arguments)
    assert outcome.status == 2 and outcome.err.count("\n") == 1 and expected in outcome.err
    assert not (tmp_path / "outputs").exists()
