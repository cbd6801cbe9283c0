"""Files that are written whole or not at all, and the room on their disk."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from devrf.errors import DevrfError
from devrf.system.files import (
    DEEPEST,
    atomic_write,
    free_disk,
    read_record,
    refuse_links,
    walk,
    write_json,
)


def test_a_finished_file_stands_under_its_name_alone(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "picture.png"
    with atomic_write(path) as partial:
        # Writers tell the format by the suffix.
        assert partial.suffix == ".png" and partial != path
        partial.write_text("whole")
        assert not path.exists()
    assert path.read_text() == "whole"
    assert [p.name for p in path.parent.iterdir()] == ["picture.png"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="disk"), atomic_write(path) as partial:
        partial.write_text("half")
        raise RuntimeError("disk full")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.json"]


def test_what_the_system_refuses_is_named_by_the_file(tmp_path: Path) -> None:
    path = tmp_path / "folder"
    path.mkdir()
    (path / "a").write_text("")
    with pytest.raises(OSError) as caught, atomic_write(path) as partial:
        partial.write_text("no file takes the place of a folder")
    assert caught.value.filename == str(path)
    with pytest.raises(OSError) as caught, atomic_write(path / "a" / "b"):
        pass
    assert caught.value.filename == str(path / "a")
    # An error of another file is that file's.
    with pytest.raises(FileNotFoundError) as caught, atomic_write(path / "c"):
        (tmp_path / "missing").read_text()
    assert caught.value.filename == str(tmp_path / "missing")


def test_json_takes_the_place_of_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    path.write_text("{ damaged")
    write_json(path, {"a": 1, "b": {"c": None}})
    assert json.loads(path.read_text()) == {"a": 1, "b": {"c": None}}


def test_a_pipe_is_no_record(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.json")
    with pytest.raises(ValueError, match="not a regular file"):
        read_record(tmp_path / "a.json")


def test_a_disk_is_that_of_the_first_folder_that_exists(tmp_path: Path) -> None:
    assert free_disk(tmp_path) == pytest.approx(free_disk(tmp_path / "not" / "yet"), rel=0.05)


def test_only_so_many_folders_in_one_another_are_looked_into(tmp_path: Path) -> None:
    """Python's own walk ends in an error where they are a thousand."""
    (tmp_path / "/".join("a" * (DEEPEST + 2))).mkdir(parents=True)
    (tmp_path / ".hidden").mkdir()
    assert [len(path.relative_to(tmp_path).parts) for path, _, _ in walk(tmp_path)] == [
        *range(DEEPEST + 1)
    ]


def test_links_to_what_is_in_the_folder_are_as_wandb_leaves_them(tmp_path: Path) -> None:
    (tmp_path / "run" / "wandb" / "run-1").mkdir(parents=True)
    (tmp_path / "run" / "wandb" / "latest-run").symlink_to("run-1")
    refuse_links(tmp_path / "run")
    (tmp_path / "linked").symlink_to(tmp_path / "run")
    refuse_links(tmp_path / "linked")
    with pytest.raises(DevrfError, match="linked: a link or a pipe"):
        refuse_links(tmp_path / "linked", itself=True)
    (tmp_path / "run" / "wandb" / "run_id").symlink_to(tmp_path / "run-1")
    with pytest.raises(DevrfError, match="run_id: a link or a pipe"):
        refuse_links(tmp_path / "run")
