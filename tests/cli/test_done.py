"""What a pipeline has scored and filmed is not done again."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """A copy of the folder of a whole tiny run."""
    return Path(shutil.copytree(trained[0], tmp_path / "run"))


def stamps(run: Path) -> dict[str, int]:
    paths = [*run.glob("*.json"), *run.glob("*.csv"), *run.glob("images/*"), *run.glob("videos/*")]
    return {path.name: path.stat().st_mtime_ns for path in paths}


def test_a_finished_run_says_so_and_reads_nothing(devrf, tiny, run, monkeypatch):
    def unread(self):
        raise AssertionError("the scene was read")

    before = stamps(run)
    monkeypatch.setattr("devrf.data.rendered.RenderedDataModule.load", unread)
    outcome = devrf(*tiny, "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    assert "evaluate: done already (frames.csv, " in outcome.out
    assert "render: done already (videos/held_out.mp4, videos/orbit.mp4)" in outcome.out
    assert stamps(run) == before


@pytest.mark.parametrize(
    ("typed", "redone"),
    [
        (["stage=evaluate"], {"metrics.json", "frames.csv", "static.png", "dynamic.png"}),
        (["video.frames=3"], {"held_out.mp4", "orbit.mp4"}),
        (["evaluation.metrics=[]"], {"metrics.json", "frames.csv", "static.png", "dynamic.png"}),
    ],
)
def test_what_is_asked_for_or_differs_is_done(devrf, tiny, run, typed, redone):
    before = stamps(run)
    assert devrf(*tiny, "hydra.run.dir=run", *typed).status == 0
    assert {name for name, stamp in stamps(run).items() if before[name] != stamp} == redone


def test_what_is_missing_is_made(devrf, tiny, run):
    (run / "videos" / "orbit.mp4").unlink()
    before = stamps(run)
    outcome = devrf(*tiny, "hydra.run.dir=run")
    assert outcome.status == 0 and "evaluate: done already" in outcome.out
    now = stamps(run)
    assert (run / "videos" / "orbit.mp4").is_file()
    assert now["metrics.json"] == before["metrics.json"]
