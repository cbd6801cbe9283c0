"""The report's folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import devrf
from devrf.errors import DevrfError
from devrf.reporting.runs import collect
from devrf.reporting.write import NO_PLOTS, ReportSettings, write_report


def files(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_it_lies_beside_the_runs_and_is_none(runs, ran):
    pytest.importorskip("matplotlib", reason="needs devrf[plots]")
    ran("a", frames=[(0.0, 20.0), (1.0, 21.0)])
    written = write_report(ReportSettings(runs))
    assert written.path == runs / "report" / "report.md"
    plots = {"figures/psnr_against_seconds", "figures/psnr_over_time_robot"}
    assert files(runs / "report") == {
        "report.md",
        "report.csv",
        "report.tex",
        *(f"{p}.png" for p in plots),
        *(f"{p}.pdf" for p in plots),
    }
    for plot in plots:
        assert f"(<{plot}.png>)" in written.path.read_text(encoding="utf-8")
    again = write_report(ReportSettings(runs))
    assert len(again.table.found.runs) == 1 and not again.table.found.skipped
    assert len(collect(runs).runs) == 1


def test_it_can_be_written_elsewhere(runs, ran, tmp_path):
    ran("a")
    written = write_report(ReportSettings(runs, into=tmp_path / "some" / "where"))
    assert written.path == tmp_path / "some" / "where" / "report.md"
    assert not (runs / "report").exists()


def test_failures_alone_are_a_report(runs, failed):
    failed("a", "out of luck")
    text = write_report(ReportSettings(runs)).path.read_text(encoding="utf-8")
    assert "0 finished runs" in text and "out of luck" in text


@pytest.mark.parametrize("damaged", [False, True])
def test_no_runs_are_a_mistake_and_nothing_is_written(runs, damaged):
    if damaged:
        (runs / "metrics.json").write_text("{")
    with pytest.raises(DevrfError, match="report.runs: no finished run below") as error:
        write_report(ReportSettings(runs))
    assert ("damaged" in str(error.value)) == damaged and "\n" not in str(error.value)
    assert not (runs / "report").exists()


def test_without_matplotlib_there_are_tables_and_a_line(runs, ran, monkeypatch):
    monkeypatch.delitem(sys.modules, "devrf.reporting.plots", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    ran("a", frames=[(0.0, 20.0)])
    written = write_report(ReportSettings(runs))
    assert written.remarks == (NO_PLOTS,) and 'pip install "devrf[plots]"' in NO_PLOTS
    assert files(runs / "report") == {"report.md", "report.csv", "report.tex"}
    assert NO_PLOTS.split("(")[0] in written.path.read_text(encoding="utf-8")


def test_it_needs_no_torch(runs, ran):
    ran("a")
    script = (
        "import sys; from devrf.reporting.write import ReportSettings, write_report\n"
        f"write_report(ReportSettings({str(runs)!r}))\n"
        "assert not {'torch', 'lightning', 'hydra'} & set(sys.modules)\n"
    )
    source = str(Path(devrf.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={"PYTHONPATH": source, "HOME": str(runs)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
