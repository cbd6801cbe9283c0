"""What is found below a folder, and what is not."""

from __future__ import annotations

import json
import math
import sys
import tracemalloc

import pytest

from devrf.apps.report.runs import SKIPPED, collect, metric_over_time
from devrf.apps.report.write import write_report
from devrf.apps.settings import ReportSettings


def one(folder):
    (run,) = collect(folder).runs.to_dict("records")
    return run


def test_finished_runs_are_found_at_any_depth_in_the_order_of_their_jobs(runs, ran):
    for name in ("10_robot", "2_robot", "lego/paper/x", "sweeps/monday/0_robot", ".cache"):
        ran(name)
    found = collect(runs)
    names = ["2_robot", "10_robot", "lego/paper/x", "sweeps/monday/0_robot"]
    assert list(found.runs["folder"]) == names and not found.skipped


def test_a_record_is_read_back(ran):
    typed = {"overrides": ["ablation=full", "seed=3"], "seed": 3, "wall_seconds": {"evaluate": 7}}
    folder = ran("a", scores={"psnr": 30.5}, seconds=(17.5, 38.0), gpu=(2.0, 3.25), **typed)
    run = one(folder)
    assert (run["folder"], run["path"], run["scene"]) == ("a", folder, "robot")
    assert run["dynamic.psnr"] == 30.5 and run["dynamic.lpips"] is None
    assert (run["train_seconds"], run["peak_gpu_gb"]) == (55.5, 3.25)
    assert run["run.wall_seconds.evaluate"] == 7 and run["run.device"] == "a processor"
    assert run["run.overrides"] == ["ablation=full", "seed=3"] and run["run.seed"] == 3
    assert run["run.choices.ablation"] == "full"


@pytest.mark.parametrize(
    ("protocol", "static", "seconds"),
    [("two_stage", 10, 48), ("two_stage", None, math.nan), ("joint", None, 38), ("dynamic", 1, 39)],
)
def test_the_time_is_that_of_the_stages_of_the_protocol(ran, protocol, static, seconds):
    run = one(ran("new", method="dnerf", protocol=protocol, seconds=(static, 38.0)))
    assert (run["method"], run["protocol"]) == ("dnerf", protocol)
    assert run["train_seconds"] == pytest.approx(seconds, nan_ok=True)


def test_a_failure_is_told_in_one_line(runs, failed):
    failed("0_robot", "data.frames: expected\n2 or more")
    (failure,) = collect(runs).failures.to_dict("records")
    assert (failure["folder"], failure["scene"]) == ("0_robot", "robot")
    assert failure["error"] == "data.frames: expected 2 or more" and failure["mistake"] is True
    assert failure["run.overrides"] == ["ablation=base"]


@pytest.mark.parametrize(
    "content", [b"{", b"\xff", b"[1, 2]", b'{"scene": "robot", "error": 3, "run": {"seed": 1}}']
)
def test_damaged_records_are_skipped_with_a_line_that_says_where(runs, ran, content):
    ran("good")
    for name in ("failure", "metrics"):
        (runs / name).mkdir()
        (runs / name / f"{name}.json").write_bytes(content)
    found = collect(runs)
    assert list(found.runs["folder"]) == ["good"] and found.failures.empty
    assert len(found.skipped) == 2
    for line, name in zip(found.skipped, ("failure", "metrics"), strict=True):
        assert line.startswith(f"{runs / name / name}.json: skipped; it is damaged, or not as")


HUGE = {f"k{k}": k for k in range(200_000)}
STRANGE = {
    "scene": [["a"], {"a": 1}, 5, None, "", "x" * 10**6],
    "method": [None],
    "protocol": [[], None],
    "at_rest": ["x"],
    "static": [[], 1],
    "dynamic": [[], {"psnr": "x"}, {"psnr": []}],
    "run": [
        [],
        {"overrides": 5},
        {"git": 5},
        {"device": [1]},
        {"image_size": [1]},
    ],
    "run.git": [5],
    "further": ["x" * 10**6, HUGE, {"a" * 10**6: 1}],
}
STRANGE["run"] += [{"checkpoint": [1]}, {"overrides": [""] * 1001}]


@pytest.mark.parametrize(
    ("key", "value"), [(k, v) for k, values in STRANGE.items() for v in values]
)
def test_records_that_no_run_writes_are_skipped(runs, ran, key, value):
    ran("good")
    file = ran("strange") / "metrics.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), key: value}))
    found = collect(runs)
    assert list(found.runs["folder"]) == ["good"]
    assert found.skipped == (SKIPPED % file,)


@pytest.mark.parametrize("key", ["scene", "method", "protocol"])
def test_records_that_do_not_say_what_was_learned_are_skipped(runs, ran, key):
    ran("good")
    file = ran("strange") / "metrics.json"
    record = json.loads(file.read_text()) | {"static": {"seconds": 1.0}}
    file.write_text(json.dumps({k: v for k, v in record.items() if k != key}))
    found = collect(runs)
    assert list(found.runs["folder"]) == ["good"]
    assert found.skipped == (SKIPPED % file,)


FURTHER = [
    {"dynamic": {"psnr": 10**400, "ssim": -1e308, "lpips": math.nan, "seconds": "x"}},
    {"static": {"psnr": 1e308, "seconds": 1e300}, "run": {"seed": "x", "choices": []}},
    {
        "run": {
            "choices": {"experiment": [1], "ablation": {"a": []}},
            "settings": {"priors": []},
        }
    },
    {"row": 1, "label": [1], "PSNR": "x", "path": 5, "status": {}, "budget": 3, "views": "q"},
    {"scene": "$x^{$", "run": {"train_views": [1], "frames": {"a": 2}, "overrides": None}},
    {"scene": "x" * 255, "run": {"settings": {"schedule.seconds": 1e300, "k": "v" * 9999}}},
]


def test_other_values_are_reported_as_far_as_they_are_known(runs, ran):
    ran("good", curve=[(0.0, 20.0)])
    for k, further in enumerate(FURTHER):
        file = ran(f"other{k}", curve=[(0.0, 1e308), (1.0, 20.0)]) / "metrics.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), **further}))
    assert "skipped" not in write_report(ReportSettings(runs))
    assert len(collect(runs).runs) == 1 + len(FURTHER)


def test_runs_whose_settings_have_other_names_each_are_skipped_from_some_on(runs, ran):
    """A table has a cell for each name in each run: of 300 runs, 80 million."""
    for run in range(8):
        ran(f"{run}_a", settings={f"a.{run}_{k}": k for k in range(900)})
    found = collect(runs)
    assert list(found.runs["folder"]) == [f"{run}_a" for run in range(5)]
    assert len(found.runs.columns) < 5100 and len(found.skipped) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="here all names are UTF-8")
def test_a_run_whose_name_is_not_utf8_is_skipped(runs, ran):
    ran("good").rename(runs / "caf\udce9")  # b"caf\xe9" on the disk
    found = collect(runs)
    assert found.runs.empty
    assert found.skipped == (rf"{runs}/caf\xe9: its name is not UTF-8 text; rename it",)


def test_of_records_without_end_only_so_much_is_read_as_devrf_writes(runs, ran):
    folder = ran("endless")
    for name in ("failure.json", "metrics.json", "frames.csv"):
        with (folder / name).open("wb") as file:
            file.truncate(2**31)  # of zeros, which take no room on the disk
    tracemalloc.start()
    try:
        assert len(collect(runs).skipped) == 2 and metric_over_time(folder, "psnr").empty
        assert tracemalloc.get_traced_memory()[1] < 2**30
    finally:
        tracemalloc.stop()


def test_curves_are_over_the_dynamic_images_views_of_a_time_averaged(ran, caplog):
    folder = ran("a", curve=[(1.0, 20.0), (0.0, 30.0), (0.0, 32.0)])
    assert metric_over_time(folder, "psnr").to_dict() == {0.0: 31.0, 1.0: 20.0}
    assert metric_over_time(folder, "ssim").empty
    (folder / "frames.csv").write_bytes(b"capture,time,psnr\ndynamic,x,3\n")
    assert metric_over_time(folder, "psnr").empty and caplog.messages == [
        SKIPPED % (folder / "frames.csv")
    ]
    (folder / "frames.csv").write_text("capture,time,psnr\ndynamic,0,3\n\ndynamic,1,4\n")
    assert metric_over_time(folder, "psnr").to_dict() == {0.0: 3.0, 1.0: 4.0}
    (folder / "frames.csv").write_text(f"capture,time,psnr{',a' * 100_000}\ndynamic,0,3\n")
    assert metric_over_time(folder, "psnr").to_dict() == {0.0: 3.0}  # in pandas it takes minutes
    (folder / "frames.csv").write_text(
        f"capture,time,psnr{',' * 10**6}\n" + "dynamic,0,3\n" * 10**4
    )
    assert metric_over_time(folder, "psnr").to_dict() == {0.0: 3.0}  # not rows times columns
    (folder / "frames.csv").write_text(f"capture,time,psnr\ndynamic,0,{10**400}\n")
    assert metric_over_time(folder, "psnr").empty and metric_over_time(ran("b"), "psnr").empty
