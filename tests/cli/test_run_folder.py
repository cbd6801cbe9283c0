"""One process at a time works in a run's folder, and a mistake leaves none behind."""

from __future__ import annotations

import errno
import os
import re
import shutil
import time
from pathlib import Path

import pytest
from filelock import FileLock
from omegaconf import OmegaConf

from devrf.cli.run_folder import archive_previous, working_in
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
    outcome = devrf(*command)
    assert outcome.status == 2
    assert re.fullmatch(
        rf"devrf: run: another devrf process \(pid {first} on \S+, since \S+ \S+\) works "
        r"in this folder; wait for it, or use hydra.run.dir=FOLDER\n",
        outcome.err,
    )
    # Another mistake leaves the first one's folder alone, too.
    assert devrf("data=inward", "hydra.run.dir=run").status == 2
    assert seen(tmp_path) == before
    # A report of other runs may be written meanwhile.
    assert "no finished run below run" in devrf("stage=report", "report.runs=run").err
    warm.end(first)
    assert devrf("stage=prepare", "prepare.into=scene", *tiny, "hydra.run.dir=run").status == 0
    assert os.listdir(tmp_path / "run" / ".devrf") == ["lock"]


@pytest.mark.parametrize("why", [errno.EACCES, errno.EROFS, errno.ENOENT])  # the last is /proc's
def test_a_folder_that_cannot_be_written_is_named_with_the_words_that_choose_another(
    devrf, trained, tmp_path, monkeypatch, why
):
    def refused(*_, **__):
        raise OSError(why, os.strerror(why), "run/.devrf/lock")

    shutil.copytree(trained[0], tmp_path / "run")
    monkeypatch.setattr(FileLock, "acquire", refused)
    said = f"devrf: run: cannot be written ({os.strerror(why)}); use "
    learned = "ckpt=run/checkpoints/deformation.ckpt "
    for stage, words in [("inspect", ""), ("still", learned)]:
        outcome = devrf(f"stage={stage}", "hydra.run.dir=run")
        assert (outcome.status, outcome.err) == (2, f"{said}{words}hydra.run.dir=FOLDER\n")


def test_files_that_a_killed_process_had_begun_are_removed(devrf, tiny, tmp_path):
    files = (".partial-metrics.json", "checkpoints/.partial-canonical.ckpt", "logs/a/.partial-x")
    files += ("export/.partial-scene.glb", "images/held_out/dynamic/.partial-0.png")
    files += ("images/motion_masks/.partial-0.png", ".devrf/.partial-tasks.json")
    for name in (*files, "export/.partial-pictures/static_0/0.jpg", "notes/.partial-mine"):
        (tmp_path / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / name).write_text("half")
    for path in tmp_path.rglob(".partial-*"):
        os.utime(path, (time.time() - 100,) * 2)
    # A viewer, which takes no lock, is writing it.
    (tmp_path / "run" / "export" / ".partial-scene.html").write_text("half")
    assert devrf("stage=prepare", "prepare.into=scene", *tiny, "hydra.run.dir=run").status == 0
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob(".partial-*")}
    assert left == {"run/notes/.partial-mine", "run/export/.partial-scene.html"}


def test_a_sweep_and_its_jobs_have_their_folders_to_themselves(devrf, hanging, tiny, tmp_path):
    sweep = ("stage=canonical", "hydra.sweep.dir=sweep", "seed=0,1")
    first = hanging("-m", "hydra.sweep.dir=sweep", "seed=0,1")
    before = seen(tmp_path)
    outcome = devrf("-m", *tiny, *sweep)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: sweep: another devrf process (pid {first} on ")
    single = devrf(*tiny, "stage=canonical", "hydra.run.dir=sweep/0_robot_seed_0")
    assert single.status == 2 and f"(pid {first} on" in single.err
    assert seen(tmp_path) == before


@pytest.fixture
def alone(tmp_path):
    """``alone(**trainer)``: the block in which no other process works in the test's folder."""

    def block(**trainer):
        config = OmegaConf.create({"stage": "canonical", "trainer": trainer})
        return working_in(tmp_path / "run", config)

    return block


@pytest.mark.parametrize("name", ["RANK", "SLURM_PROCID"])
def test_workers_are_under_the_lock_of_rank_0(alone, tmp_path, monkeypatch, name):
    together = {"strategy": {"_target_": "devrf.engine.ddp.ManualDDP"}}
    (tmp_path / "run" / ".devrf").mkdir(parents=True)
    with FileLock(tmp_path / "run" / ".devrf" / "lock"):
        monkeypatch.setenv(name, "1")
        with alone(**together):
            pass
        # A task of many that do not learn together; the owner has not written its record yet.
        with pytest.raises(DevrfError, match=r"run: another devrf process works in"), alone():
            pass
        monkeypatch.setenv(name, "0")
        with pytest.raises(DevrfError), alone(**together):
            pass


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A run folder as Hydra leaves it to the program."""
    monkeypatch.chdir(tmp_path)
    made = tmp_path / "outputs" / "robot" / "quickstart"
    (made / ".hydra").mkdir(parents=True)
    (made / ".hydra" / "config.yaml").write_text("seed: 0\n")
    return made


def fail(folder, error, made=None):
    config = OmegaConf.create({"stage": "canonical", "trainer": {}})
    with pytest.raises(type(error)), working_in(folder, config):
        (folder / "run.log").write_text("reading the scene\n")
        if made:
            (folder / made).write_text("made")
        raise error


def test_a_mistake_leaves_nothing(folder, tmp_path):
    fail(folder, DevrfError("data.root: wrong"))
    assert not list(tmp_path.iterdir())


def test_a_mistake_of_a_worker_leaves_the_folder_to_rank_0(folder, monkeypatch):
    monkeypatch.setenv("RANK", "1")
    config = OmegaConf.create({"stage": "canonical", "trainer": {"strategy": {}}})
    with pytest.raises(DevrfError), working_in(folder, config):
        raise DevrfError("trainer.devices: wrong")
    assert (folder / ".hydra" / "config.yaml").is_file()


def test_other_folders_stay(folder, tmp_path, tmp_path_factory, monkeypatch):
    (folder.parent / "paper").mkdir()
    fail(folder, DevrfError("data.root: wrong"))
    assert [p.name for p in folder.parent.iterdir()] == ["paper"]
    # The parents of a folder elsewhere.
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "mine"
    (elsewhere / "run" / ".hydra").mkdir(parents=True)
    fail(elsewhere / "run", DevrfError("data.root: wrong"))
    assert elsewhere.is_dir() and not list(elsewhere.iterdir())
    # The working folder.
    monkeypatch.chdir(elsewhere)
    fail(elsewhere, DevrfError("data.root: wrong"))
    assert elsewhere.is_dir()


@pytest.mark.parametrize(
    ("error", "made"),
    [
        (DevrfError("loss: wrong"), "metrics.json"),  # a first result
        (RuntimeError("ours"), None),  # the log of a fault of the program
    ],
)
def test_results_and_faults_leave_the_folder(folder, error, made):
    fail(folder, error, made)
    assert (folder / "run.log").is_file() and (made is None or (folder / made).is_file())
    fail(folder, DevrfError("ckpt: wrong"))  # of an earlier run
    assert (folder / "run.log").is_file()


def test_an_archive_gets_a_free_name(tmp_path):
    for name in ("previous-1", "previous-12", "previous-x", ".hydra", ".devrf"):
        (tmp_path / name).mkdir()
    archive_previous(tmp_path)
    assert not (tmp_path / "previous-13").exists()
    (tmp_path / "metrics.json").write_text("{}")
    archive_previous(tmp_path)
    assert [path.name for path in (tmp_path / "previous-13").iterdir()] == ["metrics.json"]
