"""The same seed on the same device gives the same numbers, in whichever process."""

from __future__ import annotations

import json
from pathlib import Path

import pytest


def scores(folder: Path) -> dict[str, float]:
    sections = json.loads((folder / "metrics.json").read_text())
    return {
        f"{section}.{name}": value
        for section in ("static", "dynamic")
        for name, value in sections[section].items()
        if value is not None and "second" not in name and name != "checkpoint_mb"
    }


@pytest.mark.parametrize("arguments", [(), ("deterministic=true",)], ids=["usual", "deterministic"])
def test_another_process_comes_to_the_same_scores(warm, tiny, trained, tmp_path, arguments):
    outcome = warm(tmp_path, *tiny, *arguments, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.out
    expected = scores(trained[0])
    assert len(expected) > 8
    assert scores(tmp_path / "run") == pytest.approx(expected, abs=1e-6, rel=0)


def test_another_seed_comes_to_other_scores(warm, tiny, trained, tmp_path):
    assert warm(tmp_path, *tiny, "seed=1", "hydra.run.dir=run").status == 0
    assert scores(tmp_path / "run") != pytest.approx(scores(trained[0]), abs=1e-6, rel=0)
