"""The scripts in ``benchmarks/``, on a tiny run."""

from __future__ import annotations

import importlib
import json
import runpy
import shutil
import sys
import time
from pathlib import Path

import pytest
from hydra.core.hydra_config import HydraConfig

from devrf.methods.devrf import pixel_pools

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch, tmp_path):
    """``benchmark(script, *arguments)``: what the script writes, run in a folder of the test's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.setattr(HydraConfig.instance(), "cfg", HydraConfig.instance().cfg)

    def run(script, *arguments):
        monkeypatch.setattr(sys, "argv", [script, *arguments, "--json", "found.json"])
        runpy.run_path(str(FOLDER / f"{script}.py"), run_name="__main__")
        return json.loads((tmp_path / "found.json").read_text())

    return run


def test_training_at_each_resolution_with_what_was_learned(
    benchmark, tmp_path, tiny, trained, capsys
):
    shutil.copytree(trained[0] / "checkpoints", tmp_path / "run" / "checkpoints")
    before = (tmp_path / "run" / "checkpoints" / "deformation.ckpt").read_bytes()
    found = benchmark(
        "training",
        *tiny,
        "schedule.canonical.search_iterations=20",
        "hydra.run.dir=run",
        "--seconds=0.05",
    )
    assert found["scene"] == "robot"
    rows = found["rows"]
    assert [(row["stage"], row["phase"].split()[0]) for row in rows] == [
        ("canonical", "search"),
        ("canonical", "fine"),
        ("canonical", "fine"),
        ("deformation", "level"),
        ("deformation", "level"),
    ]
    sides = [int(row["grid"].split("x")[0]) for row in rows]
    assert sides[1] < sides[2] and sides[3] < sides[4]
    for row in rows:
        assert row["ms"] > 0 and row["backward"] > 0 and row["optimiser"] > 0
        assert row["sampling"] > 0 and row["decoder"] > 0
    assert "| fine" in capsys.readouterr().out
    # Nothing was learned on the way.
    assert (tmp_path / "run" / "checkpoints" / "deformation.ckpt").read_bytes() == before


def test_rendering_learns_first_what_no_checkpoint_has(benchmark, tmp_path, tiny):
    found = benchmark("rendering", *tiny, "hydra.run.dir=run", "--views=2")
    row, viewer = found["rows"]
    assert (row["width"], row["height"], row["views"]) == (24, 20, 2)
    assert row["new time"] > 0 and row["same time"] > 0
    assert (viewer["width"], viewer["height"]) == (320, 240)
    assert viewer["camera turns"] > 0 and viewer["time runs, too"] > 0
    assert (tmp_path / "run" / "checkpoints" / "deformation.ckpt").exists()


def test_choosing_pixels_tells_seconds_of_both_blocks(monkeypatch, tmp_path, tiny_data, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.setattr(HydraConfig.instance(), "cfg", HydraConfig.instance().cfg)
    monkeypatch.setattr(pixel_pools, "MOST_BLOCK", pixel_pools.MOST_BLOCK)
    monkeypatch.setattr(sys, "argv", ["choosing_pixels", *tiny_data])
    runpy.run_path(str(FOLDER / "choosing_pixels.py"), run_name="__main__")
    hull, *rows = [
        line
        for line in capsys.readouterr().out.splitlines()
        if line.startswith(("6 images", "side"))
    ]
    assert hull.startswith("6 images of 24x20: hull ")
    assert [row.split(",")[0] for row in rows] == ["side 50"] * 2 + ["side 80"] * 2 + [
        "side 160"
    ] * 2


def test_the_report_of_a_gpu_records_what_fails_and_goes_on(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(FOLDER)
    report = importlib.import_module("gpu_report")

    def broken(into):
        yield {"found": 1}
        raise ValueError("out of order")

    steps = {"machine": (1, report.machine), "broken": (1, broken), "later": (1, broken)}
    monkeypatch.setattr(report, "STEPS", steps)
    report.make(tmp_path, "machine")
    with pytest.raises(ValueError, match="out of order"):
        report.make(tmp_path, "broken")
    report.write_report(tmp_path)
    page = (tmp_path / "REPORT.md").read_text()
    assert "## machine: done" in page and "## broken: failed" in page and "## later: left" in page
    assert '"found": 1' in page and "ValueError: out of order" in page


def test_a_part_counts_without_the_parts_inside_it(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    training = importlib.import_module("training")

    def work():
        with training.record_function("losses"):
            time.sleep(0.01)
            with training.record_function("decoder"):
                time.sleep(0.04)
        time.sleep(0.02)

    spent = training.parts(work, cuda=False)
    assert spent["losses"] < spent["overhead"] < spent["decoder"]
    assert spent["losses"] >= 9 and spent["decoder"] >= 39 and spent["backward"] == 0


def test_what_cannot_be_measured_is_said_in_one_line(benchmark, tmp_path, capsys):
    two = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2")
    with pytest.raises(SystemExit) as stop:
        benchmark("training", *two)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and said.count("\n") == 1 and "leave out trainer=ddp" in said
    assert not list(tmp_path.iterdir())
