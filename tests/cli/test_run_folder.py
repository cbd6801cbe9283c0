"""The folder of a run that has made nothing is removed; any other stays."""

from __future__ import annotations

import pytest

from devrf.cli.run_folder import removed_on_user_error
from devrf.errors import DevrfError


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A run folder as Hydra leaves it to the program."""
    monkeypatch.chdir(tmp_path)
    made = tmp_path / "outputs" / "robot" / "quickstart"
    (made / ".hydra").mkdir(parents=True)
    (made / ".hydra" / "config.yaml").write_text("seed: 0\n")
    return made


def fail(folder, error, made=None):
    with pytest.raises(type(error)), removed_on_user_error(folder):
        (folder / "run.log").write_text("reading the scene\n")
        if made:
            (folder / made).write_text("made")
        raise error


def test_a_mistake_leaves_nothing(folder, tmp_path):
    fail(folder, DevrfError("data.root: wrong"))
    assert not list(tmp_path.iterdir())


def test_the_working_folder_itself_stays(tmp_path, monkeypatch):
    (tmp_path / ".hydra").mkdir()
    monkeypatch.chdir(tmp_path)
    fail(tmp_path, DevrfError("data.root: wrong"))
    assert tmp_path.is_dir()


def test_parents_of_a_folder_elsewhere_stay(tmp_path_factory, folder):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "mine"
    (elsewhere / "run" / ".hydra").mkdir(parents=True)
    fail(elsewhere / "run", DevrfError("data.root: wrong"))
    assert elsewhere.is_dir() and not list(elsewhere.iterdir())


def test_other_runs_stay(folder):
    (folder.parent / "paper").mkdir()
    fail(folder, DevrfError("data.root: wrong"))
    assert [p.name for p in folder.parent.iterdir()] == ["paper"]


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


def test_an_earlier_run_stays(folder):
    (folder / "run.log").write_text("an earlier run\n")
    fail(folder, DevrfError("ckpt: wrong"))
    assert (folder / "run.log").is_file()
