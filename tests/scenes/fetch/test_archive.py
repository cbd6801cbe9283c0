"""Of an archive only the scene's folder is unpacked, and nothing lands beside it."""

from __future__ import annotations

import io
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from devrf.errors import DevrfError
from devrf.scenes.fetch.archive import unpack_scene

SCENES = {
    "data/lego/transforms_train.json": b"{}",
    "data/lego/train/r_0.png": b"picture",
    "data/ship/transforms_train.json": b"[]",
    "__MACOSX/data/lego/transforms_train.json": b"resource fork",
    "README.txt": b"read me",
}


def zipped(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def tarred(path: Path, files: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
        link = tarfile.TarInfo("data/lego/train/link.png")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
    return path


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() or path.is_symlink())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.mark.parametrize("made", [zipped, tarred])
def test_one_of_several_scenes_without_the_folders_around_it(
    tmp_path, made: Callable[[Path, dict[str, bytes]], Path]
):
    archive = made(tmp_path / "archive", SCENES)
    unpack_scene(archive, "transforms_train.json", "lego", tmp_path / "scene")
    assert contents(tmp_path / "scene") == {
        "transforms_train.json": b"{}",
        "train/r_0.png": b"picture",
    }


def test_the_only_scene_needs_no_name(tmp_path):
    archive = zipped(tmp_path / "archive", {"a/b/dataset.json": b"{}", "a/x": b""})
    unpack_scene(archive, "dataset.json", None, tmp_path / "scene")
    assert contents(tmp_path / "scene") == {"dataset.json": b"{}"}


@pytest.mark.parametrize("made", [zipped, tarred])
@pytest.mark.parametrize("name", ["lego/../../out.txt", "lego/a/../../../out.txt"])
def test_nothing_leaves_the_folder(tmp_path, made, name):
    archive = made(tmp_path / "archive", {"lego/transforms_train.json": b"{}", name: b"out"})
    with pytest.raises(DevrfError, match="outside its folder"):
        unpack_scene(archive, "transforms_train.json", None, tmp_path / "deep" / "scene")
    assert not list(tmp_path.rglob("out.txt"))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"<html>not an archive</html>", "cannot be unpacked"),
        (b"", "cannot be unpacked"),
        (None, "holds no hotdog with transforms_train.json"),
    ],
)
def test_another_file_than_expected_is_refused(tmp_path, content, expected):
    archive = zipped(tmp_path / "archive", SCENES)
    if content is not None:
        archive.write_bytes(content)
    with pytest.raises(DevrfError, match=expected):
        unpack_scene(archive, "transforms_train.json", "hotdog", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_a_damaged_member_is_refused(tmp_path):
    archive = zipped(tmp_path / "archive", {"lego/transforms_train.json": b"content" * 9})
    archive.write_bytes(archive.read_bytes().replace(b"content", b"Content", 1))
    with pytest.raises(DevrfError, match="cannot be unpacked .*CRC"):
        unpack_scene(archive, "transforms_train.json", None, tmp_path / "scene")


def test_what_does_not_fit_on_the_disk_is_not_begun(tmp_path, monkeypatch):
    monkeypatch.setattr("devrf.scenes.fetch.archive.free_disk", lambda folder: 1)
    with pytest.raises(DevrfError, match="fetch.into: .* are free"):
        unpack_scene(
            zipped(tmp_path / "archive", SCENES), "transforms_train.json", "lego", tmp_path / "s"
        )
    assert not (tmp_path / "s").exists()
