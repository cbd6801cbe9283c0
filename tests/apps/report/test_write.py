"""The report's folder: text, plots, videos, a row a run."""

from __future__ import annotations

import csv
import re
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest

from devrf.apps.report.runs import SKIPPED, collect
from devrf.apps.report.write import write_report
from devrf.apps.settings import ReportSettings
from devrf.errors import DevrfError
from devrf.system.printed import is_shown


def files(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_a_report_is_written_beside_the_runs_and_not_taken_for_one(runs, ran):
    ran("a", curve=[(0.0, 20.0), (1.0, 21.0)])
    text = write_report(ReportSettings(runs))
    assert text.endswith(f"\nreport written to {runs / 'report' / 'report.md'}")
    plots = {"figures/psnr_against_seconds", "figures/psnr_over_time_robot"}
    assert files(runs / "report") == {
        "report.md",
        "report.csv",
        "report.tex",
        *(f"{p}.png" for p in plots),
        *(f"{p}.pdf" for p in plots),
    }
    for plot in plots:
        assert f"(<{plot}.png>)" in (runs / "report" / "report.md").read_text(encoding="utf-8")
    again = collect(runs)
    assert len(again.runs) == 1 and not again.skipped


def test_csv_has_a_row_for_each_run_and_failure_and_every_number(runs, ran, failed):
    ran("a", scores={"psnr": 31.0}, seconds=(3, 20), seed=1, overrides=["seed=1"])
    ran("at_rest", scores={"psnr": None})
    failed("7_robot", "data.frames: expected 2, or more", overrides=["data.frames=1", "seed=0"])
    write_report(ReportSettings(runs))
    with (runs / "report" / "report.csv").open(newline="", encoding="utf-8") as file:
        rows = {row["folder"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"a", "at_rest", "7_robot"}
    assert rows["at_rest"]["row"] == ""
    expected = {"status": "finished", "row": "Ours w/ c2f, tv, cycle, flow", "run.seed": "1"}
    expected |= {"dynamic.psnr": "31.0", "dynamic.lpips": "", "train_seconds": "23.0"}
    assert rows["a"].items() >= expected.items()
    expected = {"status": "failed", "error": "data.frames: expected 2, or more", "mistake": "true"}
    expected |= {"run.overrides": "data.frames=1 seed=0", "run.choices.ablation": "base"}
    assert rows["7_robot"].items() >= {**expected, "dynamic.psnr": ""}.items()


def test_failures_alone_are_told(runs, failed):
    failed("0_robot", "data.frames: expected 2")
    assert write_report(ReportSettings(runs)).startswith("failed: 0_robot: data.frames: expected 2")


def test_damaged_runs_alone_are_an_error_and_nothing_is_written(runs):
    (runs / "metrics.json").write_text("{")
    with pytest.raises(DevrfError, match="report.runs: no finished run below .*damaged"):
        write_report(ReportSettings(runs))
    assert not (runs / "report").exists()


def test_a_sweep_imports_nothing_heavy_before_its_report():
    modules = "devrf.cli.config, devrf.cli.sweep"
    heavy = {"torch", "pandas", "matplotlib"}
    script = f"import sys, {modules}; assert not {heavy} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# Videos of a scene's rows side by side.

TRUTH, DEPTH = (40, 40, 40), (200, 200, 200)


def film(folder, colors, height=48):
    """A run's video of its held-out views: truth, rendering in some colour, depth."""
    (folder / "videos").mkdir()
    pictures = np.empty((len(colors), height, 3 * height, 3), np.uint8)
    for picture, color in zip(pictures, colors, strict=True):
        for column, shown in enumerate((TRUTH, color, DEPTH)):
            picture[:, column * height : (column + 1) * height] = shown
    iio.imwrite(folder / "videos" / "held_out.mp4", pictures, fps=10)


def test_each_row_is_a_tile_beside_the_truth_at_the_same_time(runs, ran, monkeypatch):
    red, green, blue = (220, 30, 30), (30, 180, 30), (30, 30, 220)
    monkeypatch.setattr("devrf.apps.report.write.LONGEST", 3)
    film(ran("a", method="devrf", protocol="two_stage"), [red, red, green, blue])
    film(ran("b", method="dnerf", protocol="joint"), [blue, blue], height=64)
    ran("c", method="nsff", protocol="joint")  # filmed nothing
    write_report(ReportSettings(runs))
    text = (runs / "report" / "report.md").read_text(encoding="utf-8")
    assert "(<videos/side_by_side_robot.mp4>)" in text
    pictures = iio.imread(runs / "report" / "videos" / "side_by_side_robot.mp4")
    assert len(pictures) == 2  # as many as the shorter video
    # Labels stand above pictures of 48 pixels.
    for picture, first in zip(pictures, (red, green), strict=True):
        tiles = [picture[46, 24], picture[46, 76], picture[46, 128]]
        for found, wanted in zip(tiles, (TRUTH, first, blue), strict=True):
            assert np.abs(found.astype(int) - wanted).max() < 24
    # Of large pictures fewer are read.
    monkeypatch.setattr("devrf.apps.report.write.MOST_PIXELS", 64 * 3 * 64)
    write_report(ReportSettings(runs))
    assert len(iio.imread(runs / "report" / "videos" / "side_by_side_robot.mp4")) == 1


def test_a_film_that_cannot_be_read_is_left_out(runs, ran, caplog):
    names = ("a", "cut", "junk", "list", "z")
    for name, ablation in zip(
        names, ("base", "c2f", "c2f_tv", "c2f_tv_cycle", "full"), strict=True
    ):
        film(ran(name, ablation=ablation), [TRUTH])
    broken = {name: runs / name / "videos" / "held_out.mp4" for name in names[1:-1]}
    data = broken["cut"].read_bytes()
    broken["cut"].write_bytes(data[: len(data) // 2])
    broken["junk"].write_bytes(b"x")
    listed = b"ffconcat version 1.0\nfile ../../a/videos/held_out.mp4\n"
    broken["list"].write_bytes(listed)
    write_report(ReportSettings(runs))
    assert caplog.messages == [SKIPPED % file for file in broken.values()]
    assert iio.imread(runs / "report" / "videos" / "side_by_side_robot.mp4").shape[0] == 1


def test_nothing_that_runs_are_called_is_obeyed(runs, ran, failed):
    """By terminals, spreadsheets, and what reads Markdown or LaTeX."""
    evil = "\x1b]0;x\x07\u202e\u2028<script>$x^{$[a](javascript:1)|\\input{/etc/passwd}"
    for k, name in enumerate(("=cmd|' 'A1", "@SUM(1)")):
        ran(name, f"=1+{k}{evil}", method=f"-x{k}{evil}", curve=[(0.0, 20.0)], overrides=["+a=1"])
    failed("-2+3", f"{evil}\r\n# no heading")
    written = write_report(ReportSettings(runs))
    text, table, tex = (
        (runs / "report" / f"report.{kind}").read_text("utf-8") for kind in ("md", "csv", "tex")
    )
    for shown in (written, text, table, tex):
        assert all(map(is_shown, shown.split("\n")))
    assert not re.search(r"(?<!\\)(<script|\[a|\|\\input)|^# no", text, re.MULTILINE)
    assert r"\input{/etc" not in tex.split("\n%")[1]
    cells = [cell for row in csv.reader(table.splitlines()) for cell in row]
    assert "'=cmd|' 'A1" in cells and "'+a=1" in cells
    assert not [cell for cell in cells if cell[:1] in ("=", "+", "-", "@")]
