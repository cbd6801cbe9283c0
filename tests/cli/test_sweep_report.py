"""``stage=report``, and the report that a sweep ends with."""

from __future__ import annotations

import csv
import json
import shutil

import pytest


def everything_in(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


@pytest.fixture
def finished(trained, tmp_path):
    """A folder with two finished runs."""
    for name in ("one", "two"):
        (tmp_path / "mine" / name).mkdir(parents=True)
        for file in ("metrics.json", "frames.csv"):
            shutil.copy(trained[0] / file, tmp_path / "mine" / name / file)
    # Another run, although its numbers are the same.
    path = tmp_path / "mine" / "two" / "metrics.json"
    found = json.loads(path.read_text())
    found["run"]["checkpoint"] = "another"
    path.write_text(json.dumps(found))
    return tmp_path / "mine"


def test_finished_runs_become_a_report_and_nothing_else_is_left(
    devrf, tmp_path, finished, monkeypatch
):
    def run_stage(*arguments):
        raise AssertionError("a report needs no torch")

    monkeypatch.setattr("devrf.cli.run.run_stage", run_stage)
    before = everything_in(tmp_path)
    outcome = devrf("stage=report", "report.runs=mine")
    assert (outcome.status, outcome.err) == (0, "")
    assert outcome.out.splitlines()[-1] == "report written to mine/report/report.md"
    psnr = json.loads((finished / "one" / "metrics.json").read_text())["deformation"]["psnr"]
    assert f"{psnr:.2f} ± 0.00" in outcome.out and "(n = 2)" in outcome.out
    made = everything_in(tmp_path) - before
    assert {"mine/report", *(f"mine/report/report.{s}" for s in ("md", "csv", "tex"))} <= made
    assert all(name.startswith("mine/report") for name in made)
    assert not (finished / "report" / ".hydra").exists()
    with (finished / "report" / "report.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["folder"] for row in rows] == ["one", "two"]
    assert all(float(row["deformation.psnr"]) == psnr for row in rows)


def test_a_reports_setting_may_refer_to_another_section(devrf, finished):
    outcome = devrf("stage=report", "report.runs=${trainer.accelerator}")
    assert outcome.err.startswith("devrf: report.runs: no folder auto")


def test_outputs_are_reported_by_default_and_no_scene_is_read(devrf, tmp_path, finished):
    finished.rename(tmp_path / "outputs")
    outcome = devrf("stage=report", "data=lego", "data.root=nowhere")
    assert outcome.out.endswith("report written to outputs/report/report.md\n")


@pytest.mark.parametrize("name", ["report", "report/figures", "report/report.md"])
def test_a_report_is_not_written_through_a_link(devrf, tmp_path, finished, name):
    (tmp_path / "else").mkdir()
    (finished / name).parent.mkdir(exist_ok=True)
    (finished / name).symlink_to(tmp_path / "else")
    before = everything_in(tmp_path)
    said = f"devrf: mine/{name}: a link or a pipe; remove it: devrf writes there\n"
    for where in ((), ("hydra.run.dir=other",)):
        outcome = devrf("stage=report", "report.runs=mine", *where)
        assert (outcome.status, outcome.err) == (2, said)
        assert everything_in(tmp_path) <= {*before, "other"}


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["report.runs=nowhere"], "report.runs: no folder nowhere"),
        (["report.runs=empty", "report.into=there"], "report.runs: no finished run below empty"),
        (["ckpt=x"], "ckpt: stage=report starts from nothing"),
        (["report.runs=empty", "+nosuch=1"], "nosuch: no part reads it"),
        (["report.runs=empty", "output_dir=there"], "output_dir: expected "),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(devrf, tmp_path, arguments, expected):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "note").write_text("mine")
    outcome = devrf("stage=report", *arguments)
    assert outcome.status == 2
    assert outcome.err.startswith(f"devrf: {expected}") and outcome.err.count("\n") == 1
    assert everything_in(tmp_path) == {"empty", "empty/note"}


def test_one_command_makes_the_ablation_table(devrf, tmp_path, tiny):
    quick = ("data.shape=robot", "ablation=full", "evaluation.metrics=[]", "video.frames=1")
    outcome = devrf("experiment=ablation_table", *tiny, *quick, "hydra.sweep.dir=sweep")
    assert (outcome.status, outcome.err) == (0, "")
    assert outcome.out.splitlines()[-1] == "report written to sweep/report/report.md"
    jobs = {path.parent.name for path in (tmp_path / "sweep").glob("*/metrics.json")}
    assert jobs == {"0_robot"}
    text = (tmp_path / "sweep" / "report" / "report.md").read_text("utf-8")
    assert "## robot" in text
    assert not (tmp_path / "outputs").exists()
