"""stage=selfcheck: a line for each check, a record, and a status that says whether all passed."""

from __future__ import annotations

import json

import pytest

from devrf import selfcheck


def test_every_check_has_a_line_and_failures_end_with_status_2(devrf, tmp_path, monkeypatch):
    def broken(scene):
        raise ValueError("two\nlines")

    checks = {"well": lambda scene: "1 ms", "wrong": broken, "memory": selfcheck.rendering}
    monkeypatch.setattr(selfcheck, "CHECKS", checks)
    outcome = devrf("stage=selfcheck", "trainer=cpu")
    assert outcome.status == 2
    assert outcome.err == "devrf: stage=selfcheck: 1 checks failed: wrong\n"
    lines = ["passed  well: 1 ms", "failed  wrong: ValueError: two lines"]
    lines.append("skipped  memory: needs a GPU: a CPU has one renderer")
    assert [line for line in outcome.out.splitlines() if line in lines] == lines
    record = json.loads((tmp_path / "outputs" / "selfcheck" / "selfcheck.json").read_text())
    assert [check["verdict"] for check in record["checks"]] == ["passed", "failed", "skipped"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["selfcheck.only=[kernl]"], "not 'kernl'; did you mean kernel?"),
        (["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"], "leave out trainer=ddp"),
    ],
)
def test_what_cannot_be_checked_is_one_line(devrf, tmp_path, arguments, expected):
    outcome = devrf("stage=selfcheck", *arguments)
    assert outcome.status == 2 and outcome.err.count("\n") == 1 and expected in outcome.err
