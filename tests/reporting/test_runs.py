"""What is found below a folder, and what is not."""

from __future__ import annotations

import json

import pytest

from devrf.errors import DevrfError
from devrf.reporting.runs import collect


def names(found):
    return [run.name for run in found.runs]


def test_runs_are_found_at_any_depth_in_the_order_of_their_jobs(runs, ran):
    for name in ("10_robot", "2_robot", "lego/paper/x", "sweeps/monday/0_robot"):
        ran(name)
    found = names(collect(runs))
    assert found == ["2_robot", "10_robot", "lego/paper/x", "sweeps/monday/0_robot"]


def test_the_folder_may_be_a_run_itself(ran):
    folder = ran("one")
    (run,) = collect(folder).runs
    assert (run.name, run.folder, run.scene) == ("one", folder, "robot")


def test_a_run_without_metrics_is_none(runs, ran):
    ran("finished")
    (runs / "under_way" / "checkpoints").mkdir(parents=True)
    (runs / "under_way" / ".partial-metrics.json").write_text("{")
    (runs / "finished" / ".cache").mkdir()
    (runs / "finished" / ".cache" / "metrics.json").write_text("{")
    found = collect(runs)
    assert names(found) == ["finished"] and not found.skipped


def test_a_record_is_read_back(runs, ran):
    ran(
        "a",
        scores={"psnr": 30.5, "lpips": None},
        seconds=(17.5, 38.0),
        gpu=(2.0, 3.25),
        overrides=["ablation=full", "seed=3"],
        seed=3,
        train_views=4,
        wall_seconds={"evaluate": 7},
    )
    (run,) = collect(runs).runs
    assert run.number("deformation.psnr") == 30.5 and run.number("deformation.lpips") is None
    assert (run.seconds, run.gpu_gb) == (55.5, 3.25)
    assert run.number("run.wall_seconds.evaluate") == 7 and run.number("run.train_views") == 4
    assert run.text("run.device") == "a processor" and run.text("run.seed") is None
    assert run.record["run.overrides"] == "ablation=full seed=3"
    assert run.setup.seed == 3 and run.setup.choices == {"ablation": "full", "logger": "csv"}


def test_what_was_not_recorded_is_unknown(runs):
    # As versions before the records of choices, seed and views wrote it.
    old = {"scene": "robot", "deformation": {"psnr": 29.0, "seconds": 38.0}, "run": {"git": None}}
    (runs / "old").mkdir()
    (runs / "old" / "metrics.json").write_text(json.dumps(old))
    (run,) = collect(runs).runs
    assert (run.setup.choices, run.setup.overrides, run.setup.seed) == (None, (), None)
    # Both stages make the time: that of one alone is not the run's.
    assert run.seconds is None and run.gpu_gb is None and run.moving


def test_what_is_not_finite_is_unknown(runs, ran):
    ran("a", scores={"psnr": float("nan"), "ssim": float("inf")})
    (run,) = collect(runs).runs
    assert run.number("deformation.psnr") is None and run.number("deformation.ssim") is None
    assert not run.moving


def test_a_failure_is_told_in_one_line(runs, failed):
    failed("0_robot", "data.frames: expected\n2 or more")
    (failure,) = collect(runs).failures
    assert (failure.name, failure.error) == ("0_robot", "data.frames: expected 2 or more")
    assert (failure.scene, failure.mistake) == ("robot", True)
    assert failure.setup.overrides == ("ablation=base",)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[1, 2]",
        b"{}",
        b'{"scene": 3}',
        b"[" * 100_000,
        b'{"scene": "robot", "run": []}',
        b'{"scene": "robot", "deformation": 30}',
        b'{"scene": "robot", "run": {"choices": ["full"]}}',
        b'{"scene": "robot", "run": {"overrides": "seed=1"}}',
        b'{"scene": "robot", "run": {"overrides": [1]}}',
        b'{"scene": "robot", "run": {"seed": "one"}}',
    ],
)
def test_damaged_records_are_skipped_with_a_line_that_names_them(runs, ran, content):
    ran("good")
    for name in ("metrics.json", "failure.json"):
        folder = runs / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_bytes(content)
    found = collect(runs)
    assert names(found) == ["good"] and not found.failures
    assert len(found.skipped) == 2
    for line, path in zip(
        found.skipped, ("failure/failure.json", "metrics/metrics.json"), strict=True
    ):
        assert line.startswith(f"{runs / path}: skipped; ") and "\n" not in line


def test_no_folder_is_a_mistake(tmp_path):
    with pytest.raises(DevrfError, match="report.runs: no folder .*nowhere"):
        collect(tmp_path / "nowhere")


def test_curves_are_over_the_moving_images_views_of_a_time_averaged(runs, ran):
    ran("a", frames=[(1.0, 20.0), (0.0, 30.0), (0.0, 32.0)])
    (run,) = collect(runs).runs
    assert run.over_time("psnr") == ((0.0, 31.0), (1.0, 20.0))
    assert run.over_time("ssim") == () and run.over_time("nothing") == ()


@pytest.mark.parametrize("content", [b"", b"\xff", b"capture,psnr\ndynamic,3\n", b"a\0b", None])
def test_a_run_without_readable_frames_has_no_curve(runs, ran, content):
    folder = ran("a")
    if content is not None:
        (folder / "frames.csv").write_bytes(content)
    assert collect(runs).runs[0].over_time("psnr") == ()
