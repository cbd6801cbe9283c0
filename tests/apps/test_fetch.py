"""The catalogue names scenes that devrf can read; of an archive the scene's folder is unpacked."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import pytest

from devrf.apps.fetch import (
    MARKERS,
    Collection,
    PublishedScene,
    _unpacked,
    catalogue,
    published_scene,
)
from devrf.cli.config import config_folder
from devrf.errors import DevrfError

SCENES = catalogue()


def test_names_are_unique():
    names = [scene.name for scene in SCENES]
    assert len(set(names)) == len(names)
    assert {"fox", "fern", "lego"} <= set(names)


def test_each_scene_has_a_layout_and_addresses():
    for scene in SCENES:
        assert (config_folder() / "data" / f"{scene.collection.data}.yaml").is_file()
        for url in scene.downloads.values():
            assert url.startswith("https://") and not set("{} ") & set(url)
        assert scene.is_archive or MARKERS[scene.collection.data] in scene.downloads
        assert set(scene.collection.sha256) <= set(scene.collection.scenes)


def test_a_misspelt_name_is_answered_with_the_closest():
    with pytest.raises(DevrfError, match="knows no 'fxo'; choose one of fox, .*mean scene=fox"):
        published_scene("fxo")


@pytest.mark.parametrize(
    "text",
    [
        "not TOML",
        "[[collection]]\npage='https://a'\nlicence=''\ndata='inward'\nlearn=''\nurl='https://a'\n"
        "scenes.'../a'=''",
    ],
)
def test_another_catalogue_has_the_same_form(tmp_path, text):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(DevrfError, match="fetch.catalogue: .* cannot be read"):
        catalogue(tmp_path / "mine.toml")


FILES = {
    "data/lego/transforms_train.json": b"{}",
    "data/lego/train/r_0.png": b"picture",
    "data/ship/transforms_train.json": b"[]",
    "__MACOSX/data/lego/transforms_train.json": b"resource fork",
}


def lego(folder: str | None = "lego") -> PublishedScene:
    """A scene that is published in an archive."""
    words = {"page": "https://a", "licence": "", "data": "inward", "learn": "", "url": "https://a"}
    return PublishedScene("lego", "", Collection(**words, folder=folder, scenes={"lego": ""}))


def written(work: Path, files: dict[str, bytes]) -> Path:
    """An archive of files where a download leaves it."""
    archive = work / "files" / "archive"
    archive.parent.mkdir()
    with zipfile.ZipFile(archive, "w") as packed:
        for name, content in files.items():
            packed.writestr(name, content)
    return archive


def test_the_scene_alone_is_unpacked_and_nothing_leaves_its_folder(tmp_path):
    written(tmp_path, FILES)
    folder = _unpacked(lego(), tmp_path)
    assert (folder / "transforms_train.json").read_bytes() == b"{}"
    assert (folder / "train/r_0.png").read_bytes() == b"picture"
    shutil.rmtree(tmp_path / "files")
    written(tmp_path, {"lego/transforms_train.json": b"{}", "lego/../../../x.txt": b"out"})
    _unpacked(lego(None), tmp_path)
    assert [path.parent.name for path in tmp_path.parent.rglob("x.txt")] == ["lego"]


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"<html>not an archive</html>", "cannot be unpacked"), (None, "holds no hotdog with")],
)
def test_another_file_than_expected_is_refused(tmp_path, content, said):
    archive = written(tmp_path, FILES)
    if content is not None:
        archive.write_bytes(content)
    with pytest.raises(DevrfError, match=said):
        _unpacked(lego("hotdog"), tmp_path)


def test_an_archive_that_expands_beyond_what_scenes_do_is_removed(tmp_path):
    # 100 MB of zeros in 100 kB.
    archive = tmp_path / "work" / "files" / "archive"
    archive.parent.mkdir(parents=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("lego/transforms_train.json", "{}")
        packed.writestr("lego/train/r_0.png", bytes(100_000_000))
    with pytest.raises(
        DevrfError, match=r"9\d\.\d kB would unpack to 100\.0 MB, more than 20 times"
    ):
        _unpacked(lego(), tmp_path / "work")
    assert not list(tmp_path.iterdir())


def test_a_file_in_an_archive_that_holds_more_than_is_said_is_not_unpacked(tmp_path):
    archive = written(tmp_path, {"lego/transforms_train.json": b"{}", "lego/a.png": bytes(5000)})
    content = bytearray(archive.read_bytes())
    for place in (content.find(b"lego/a.png") - 30 + 22, content.rfind(b"lego/a.png") - 46 + 24):
        assert content[place : place + 4] == (5000).to_bytes(4, "little")
        content[place : place + 4] = (10).to_bytes(4, "little")
    archive.write_bytes(content)
    with pytest.raises(DevrfError, match="cannot be unpacked"):
        _unpacked(lego(), tmp_path)
