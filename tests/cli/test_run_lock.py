"""One process at a time works in a run's folder; the lock goes with its process."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path

import pytest
from filelock import FileLock, SoftFileLock
from omegaconf import OmegaConf

from devrf.cli import run_lock
from devrf.cli.run_lock import exclusive
from devrf.errors import DevrfError


@pytest.fixture
def hanging(warm, tmp_path):
    """``hanging(*arguments)``: a process that works in a folder below the test's, and hangs."""
    yield lambda *arguments: warm.hanging(tmp_path, *arguments)
    warm.end_all()


def seen(folder: Path) -> dict[str, tuple[int, int]]:
    """Every file below a folder, with its time and size."""
    # Older releases of filelock touch the empty file that they try to lock.
    found = {str(path): path.stat() for path in folder.rglob("*") if path.name != "lock"}
    return {name: (stat.st_mtime_ns, stat.st_size) for name, stat in found.items()}


def test_the_second_process_is_refused_until_the_first_is_killed(
    devrf, hanging, warm, tiny, tmp_path
):
    command = (*tiny, "stage=canonical", "hydra.run.dir=run")
    first = hanging("hydra.run.dir=run")
    before = seen(tmp_path)
    for stage in ("stage=canonical", "stage=still"):
        outcome = devrf(*command, stage)
        assert outcome.status == 2
        assert re.fullmatch(
            rf"devrf: run: another devrf process \(pid {first} on \S+, since \S+ \S+\) works "
            r"in this folder; wait for it, or use hydra.run.dir=FOLDER\n",
            outcome.err,
        )
    assert seen(tmp_path) == before
    assert devrf(*command, "hydra.run.dir=other").status == 0
    # A report of other runs may be written meanwhile.
    assert "no finished run below run" in devrf("stage=report", "report.runs=run").err
    warm.end(first)
    assert devrf(*command).status == 0
    assert (tmp_path / "run" / "checkpoints" / "canonical.ckpt").is_file()
    assert os.listdir(tmp_path / "run" / ".devrf") == ["lock"]


def test_a_mistake_beside_a_run_that_has_just_begun_leaves_its_folder(devrf, hanging, tmp_path):
    hanging("hydra.run.dir=run")
    (tmp_path / "run" / "begun").unlink()
    before = seen(tmp_path)
    assert devrf("data=inward", "hydra.run.dir=run").status == 2
    assert seen(tmp_path) == before


def test_a_sweep_and_its_jobs_have_their_folders_to_themselves(
    devrf, hanging, warm, tiny, tmp_path
):
    sweep = ("stage=canonical", "hydra.sweep.dir=sweep", "seed=0,1")
    first = hanging("-m", "hydra.sweep.dir=sweep", "seed=0,1")
    before = seen(tmp_path)
    outcome = devrf("-m", *tiny, *sweep)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: sweep: another devrf process (pid {first} on ")
    assert outcome.err.endswith("wait for it, or use hydra.sweep.dir=FOLDER\n")
    single = devrf(*tiny, "stage=canonical", "hydra.run.dir=sweep/0_robot")
    assert single.status == 2 and f"(pid {first} on" in single.err
    assert seen(tmp_path) == before
    warm.end(first)
    assert devrf("-m", *tiny, *sweep).status == 0


def test_a_job_whose_folder_is_taken_fails_and_the_others_go_on(devrf, hanging, tiny, tmp_path):
    hanging("hydra.run.dir=sweep/0_robot")
    outcome = devrf("-m", *tiny, "stage=canonical", "hydra.sweep.dir=sweep", "seed=0,1")
    assert outcome.status == 3
    assert "sweep/0_robot: another devrf process" in outcome.err.splitlines()[0]
    assert "1 of 2 jobs failed: 0_robot" in outcome.err
    assert (tmp_path / "sweep" / "1_robot" / "checkpoints" / "canonical.ckpt").is_file()


@pytest.fixture
def alone(tmp_path):
    """``alone(**trainer)``: the block in which no other process works in the test's folder."""

    def block(**trainer):
        config = OmegaConf.create({"stage": "canonical", "trainer": trainer})
        return exclusive(tmp_path / "run", config, "hydra.run.dir")

    return block


@pytest.fixture
def taken(tmp_path):
    """The test's folder, locked by a process that has not written its record yet."""
    (tmp_path / "run" / ".devrf").mkdir(parents=True)
    with FileLock(tmp_path / "run" / ".devrf" / "lock"):
        yield tmp_path / "run"


def test_the_record_lasts_as_long_as_the_lock(alone, tmp_path):
    place = tmp_path / "run" / ".devrf"
    for _ in range(2):
        with alone():
            assert (place / "process.txt").read_text().startswith(f"pid {os.getpid()} on ")
        assert os.listdir(place) == ["lock"]


@pytest.mark.parametrize("name", ["RANK", "SLURM_PROCID"])
def test_workers_are_under_the_lock_of_rank_0(alone, taken, monkeypatch, name):
    together = {"strategy": {"_target_": "devrf.engine.ddp.ManualDDP"}}
    monkeypatch.setenv(name, "1")
    with alone(**together):
        pass
    # A task of many that do not learn together; the owner has not written its record yet.
    with pytest.raises(DevrfError, match=r"run: another devrf process works in"), alone():
        pass
    monkeypatch.setenv(name, "0")
    with pytest.raises(DevrfError), alone(**together):
        pass


@pytest.mark.parametrize("error", [OSError(errno.ENOLCK, "No locks"), NotImplementedError(), None])
def test_a_file_system_without_locks_is_told_once(alone, tmp_path, monkeypatch, caplog, error):
    class WithoutLocks(SoftFileLock):  # what newer releases take to instead of an error
        def acquire(self, timeout):
            if error is not None:
                raise error
            return super().acquire(timeout)

    monkeypatch.setattr(run_lock, "FileLock", WithoutLocks)
    with alone():
        assert not os.listdir(tmp_path / "run" / ".devrf")
    assert caplog.messages == [
        f"{tmp_path / 'run'}: its file system has no locks; see that no other process works there"
    ]


def test_a_folder_that_may_not_be_written_to_is_refused(alone, monkeypatch):
    def denied(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", "lock")

    monkeypatch.setattr(FileLock, "acquire", denied)
    with pytest.raises(PermissionError), alone():
        pass
