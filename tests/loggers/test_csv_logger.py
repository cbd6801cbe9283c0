"""Training curves as CSV: continued, cut back, whole after a kill, patient on a full disk."""

from __future__ import annotations

import csv
import errno
import logging
from pathlib import Path
from typing import Any

import pytest

from devrf.errors import DevrfError
from devrf.loggers import csv_logger as module
from devrf.loggers.csv_logger import ResumableCSVLogger


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A table of three rows of the static capture and two of the dynamic one."""
    written = ResumableCSVLogger(tmp_path, "logs", "pipeline")
    for step in (10, 20, 30):
        written.log_metrics({"static/loss": 1 / step}, step)
    for step in (10, 20):
        written.log_metrics({"dynamic/loss": 2.0, "dynamic/flow": 0.5}, step)
    return tmp_path / "logs" / "pipeline" / "metrics.csv"


def again(path: Path) -> ResumableCSVLogger:
    """The logger of a run that is started again."""
    return ResumableCSVLogger(path.parents[2], "logs", "pipeline")


def test_a_row_is_on_the_disk_at_once(path):
    rows = table(path)
    assert list(rows[0]) == ["dynamic/flow", "dynamic/loss", "static/loss", "step"]
    assert [row["step"] for row in rows] == ["10", "20", "30", "10", "20"]
    assert rows[1]["static/loss"] == "0.05" and rows[1]["dynamic/loss"] == ""
    assert rows[4]["dynamic/flow"] == "0.5"


def test_rows_beyond_the_resume_point_are_dropped(path):
    curves = again(path)
    curves.drop_rows_beyond("dynamic", 10)
    assert [row["step"] for row in table(path)] == ["10", "20", "30", "10"]
    curves.drop_rows_beyond("static", 0)
    assert [row["dynamic/loss"] for row in table(path)] == ["2.0"]
    curves.drop_rows_beyond("dynamic", 0)
    assert table(path) == []


def test_a_line_that_was_cut_off_is_no_row(path):
    whole = path.read_text()
    path.write_text(whole[:-3])  # the last row's step, 20, has become 2
    again(path).log_metrics({"dynamic/loss": 2.0, "dynamic/flow": 0.5}, 20)
    assert path.read_text().split() == whole.split()


@pytest.mark.parametrize(
    "damage",
    ["step,loss\n1\n", "step\n1,2\n", f"step{',' * 10**6}\n" + "1\n" * 10**5, "step\n" * 2**21],
)
def test_a_table_without_all_cells_or_of_too_many_rows_is_damaged(path, damage):
    path.write_text(damage)
    with pytest.raises(DevrfError, match="metrics.csv: damaged; remove it"):
        again(path)


def test_long_and_wide_tables_are_read(path):
    names = ",".join(f"loss{k}" for k in range(34))
    path.write_text(f"step,{names}\n" + "".join(f"{k}{',' * 34}\n" for k in range(130_000)))
    again(path).log_metrics({"static/loss": 1.0}, 130_000)
    assert path.read_text().count("\n") == 130_002


def test_on_a_full_disk_rows_wait(path, monkeypatch, caplog):
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before, curves = path.read_text(), again(path)
    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING, logger="devrf"):
        patch.setattr(module, "atomic_write", full)
        for step in (30, 40):
            curves.log_metrics({"dynamic/loss": 1.0}, step)
        assert path.read_text() == before
    assert caplog.messages == [f"{path}: No space left on device; its rows wait in memory"]
    curves.log_metrics({"dynamic/loss": 1.0}, 50)
    assert [row["step"] for row in table(path)][-4:] == ["20", "30", "40", "50"]
