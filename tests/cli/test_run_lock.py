"""One process at a time works in a run's folder; the lock goes with its process."""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from filelock import FileLock, SoftFileLock
from omegaconf import OmegaConf

import devrf as package
from devrf.cli.run_lock import alone_in
from devrf.errors import DevrfError

# A run that says that it has begun, and goes on for longer than any test.
HANGING = """
import sys, time
import devrf.cli.steps, devrf.__main__
def hang(run):
    (run.folder / "begun").touch()
    print("begun", flush=True)
    time.sleep(600)
devrf.cli.steps.STEPS["prepare"] = (hang,)
devrf.__main__.entry()
"""
# What the system says of a file that it cannot lock.
NO_LOCKS = errno.ENOLCK


@pytest.fixture
def hanging(tmp_path):
    """``hanging(*arguments)``: a process of its own that works in a folder below the test's."""
    started = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        source = str(Path(package.__file__).parents[1])
        path = os.pathsep.join(filter(None, [source, os.environ.get("PYTHONPATH")]))
        process = subprocess.Popen(
            [sys.executable, "-c", HANGING, *arguments, "stage=prepare"],
            cwd=tmp_path,
            text=True,
            env={**os.environ, "PYTHONPATH": path, "HYDRA_FULL_ERROR": "0"},
            stdout=subprocess.PIPE,
        )
        started.append(process)
        assert process.stdout is not None
        assert any(line == "begun\n" for line in process.stdout)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def seen(folder: Path) -> dict[str, tuple[int, int]]:
    """Every file below a folder, with its time and size."""
    # Older releases of filelock touch the empty file that they try to lock.
    found = {str(path): path.stat() for path in folder.rglob("*") if path.name != "lock"}
    return {name: (stat.st_mtime_ns, stat.st_size) for name, stat in found.items()}


def test_the_second_process_is_refused_until_the_first_has_gone(devrf, hanging, tiny, tmp_path):
    command = (*tiny, "stage=canonical", "hydra.run.dir=run")
    first = hanging("hydra.run.dir=run")
    before = seen(tmp_path)
    for stage in ("stage=canonical", "stage=evaluate", "stage=still"):
        outcome = devrf(*command, stage)
        assert outcome.status == 2
        assert re.fullmatch(
            rf"devrf: run: another devrf process \(pid {first.pid} on \S+, since \S+ \S+\) works "
            r"in this folder; wait for it, or use hydra.run.dir=FOLDER\n",
            outcome.err,
        )
    assert seen(tmp_path) == before
    assert devrf(*command, "hydra.run.dir=other").status == 0
    # A report of other runs may be written meanwhile.
    assert "no finished run below run" in devrf("stage=report", "report.runs=run").err
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert devrf(*command).status == 0
    assert (tmp_path / "run" / "checkpoints" / "canonical.ckpt").is_file()
    assert not (tmp_path / "run" / ".devrf" / "process.json").exists()


def test_a_mistake_beside_a_run_that_has_just_begun_leaves_its_folder(devrf, hanging, tmp_path):
    hanging("hydra.run.dir=run")
    (tmp_path / "run" / "begun").unlink()
    before = seen(tmp_path)
    assert devrf("data=inward", "hydra.run.dir=run").status == 2
    assert seen(tmp_path) == before


def test_a_sweep_and_its_jobs_have_their_folders_to_themselves(devrf, hanging, tiny, tmp_path):
    sweep = ("stage=canonical", "hydra.sweep.dir=sweep", "seed=0,1")
    first = hanging("-m", "hydra.sweep.dir=sweep", "seed=0,1")
    before = seen(tmp_path)
    outcome = devrf("-m", *tiny, *sweep)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: sweep: another devrf process (pid {first.pid} on ")
    assert outcome.err.endswith("wait for it, or use hydra.sweep.dir=FOLDER\n")
    single = devrf(*tiny, "stage=canonical", "hydra.run.dir=sweep/0_robot")
    assert single.status == 2 and f"(pid {first.pid} on" in single.err
    assert seen(tmp_path) == before
    first.kill()
    first.wait()
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
    """``alone(**trainer)``: the block in which nobody else works in the test's folder."""

    def block(stage="canonical", **trainer):
        config = OmegaConf.create({"stage": stage, "trainer": trainer})
        return alone_in(tmp_path / "run", config, "hydra.run.dir")

    return block


@pytest.fixture
def taken(tmp_path):
    """The test's folder, locked by somebody who has not said yet who he is."""
    (tmp_path / "run" / ".devrf").mkdir(parents=True)
    with FileLock(tmp_path / "run" / ".devrf" / "lock"):
        yield tmp_path / "run"


def test_it_says_who_works_there_as_long_as_it_does(alone, tmp_path):
    said = tmp_path / "run" / ".devrf" / "process.json"
    for _ in range(2):
        with alone():
            assert json.loads(said.read_text())["pid"] == os.getpid()
        assert not said.exists()


@pytest.mark.parametrize("said", [None, "", "[]", '{"pid": 3}', "\0"])
def test_who_it_is_need_not_be_known(alone, taken, said):
    if said is not None:
        (taken / ".devrf" / "process.json").write_text(said)
    with pytest.raises(DevrfError, match=r"run: another devrf process works in"), alone():
        pass


def test_processes_that_learn_together_work_under_the_lock_of_the_first(alone, taken, monkeypatch):
    strategy = {"strategy": {"_target_": "devrf.engine.ddp.ManualDDP"}}
    for name in ("RANK", "SLURM_PROCID"):
        with monkeypatch.context() as patch:
            patch.setenv(name, "1")
            with alone(**strategy):
                pass
            # Alone, as one of several tasks that have nothing to do with each other.
            with pytest.raises(DevrfError), alone():
                pass
            patch.setenv(name, "0")
            with pytest.raises(DevrfError), alone(**strategy):
                pass


@pytest.mark.parametrize("way", ["error", "old filelock", "new filelock"])
def test_a_file_system_without_locks_is_told_once_and_the_run_goes_on(
    alone, tmp_path, monkeypatch, caplog, way
):
    if way == "new filelock":  # takes to a file that would outlive a killed process
        monkeypatch.setattr("devrf.cli.run_lock.FileLock", SoftFileLock)
    else:
        wrong = OSError(NO_LOCKS, "No locks available") if way == "error" else NotImplementedError()

        def acquire(timeout: float) -> None:
            raise wrong

        monkeypatch.setattr(
            "devrf.cli.run_lock.FileLock", lambda path: SimpleNamespace(acquire=acquire)
        )
    with caplog.at_level(logging.WARNING), alone():
        assert not list((tmp_path / "run" / ".devrf").iterdir())
    assert caplog.messages == [
        f"{tmp_path / 'run'}: its file system has no locks; see that no other process works there"
    ]


def test_a_folder_that_may_not_be_written_to_is_a_mistake(alone, monkeypatch):
    def acquire(timeout: float) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", "lock")

    monkeypatch.setattr(
        "devrf.cli.run_lock.FileLock", lambda path: SimpleNamespace(acquire=acquire)
    )
    with pytest.raises(PermissionError), alone():
        pass
