"""The catalogue names scenes that devrf can read; of an archive the scene's folder is unpacked."""

from __future__ import annotations

import io
import os
import shutil
import threading
import time
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from devrf.apps.fetch import (
    MARKERS,
    Collection,
    FetchSettings,
    PublishedScene,
    _unpacked,
    catalogue,
    fetched,
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
        "collection=5",
        "a=" + "[" * 100_000,
        "#" * (2**20 + 1),
        "a." * 30_000 + "a=1",
        *(
            f"[[collection]]\npage='https://a'\nlicence=\"{licence}\"\ndata='inward'\n"
            f"learn='{learn}'\nurl='https://a'\nscenes.a=''"
            for licence, learn in (("\\u001b[2J", ""), ("", "a=1; rm -r x"))
        ),
    ],
)
def test_another_catalogue_has_the_same_form(tmp_path, text):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(DevrfError, match="fetch.catalogue: .* cannot be read"):
        catalogue(tmp_path / "mine.toml")


def test_a_pipe_is_no_catalogue(tmp_path):
    os.mkfifo(tmp_path / "mine.toml")
    with pytest.raises(DevrfError, match="cannot be read"):
        catalogue(tmp_path / "mine.toml")


def test_words_of_an_address_are_replaced_and_nothing_else_is_read():
    text = "https://a/{scene}/{file}?{scene.__class__}{0}{file"
    downloads = published("lego", url=text, files=["b.png"]).downloads
    assert downloads == {"b.png": "https://a/lego/b.png?{scene.__class__}{0}{file"}


FILES = {
    "data/lego/transforms_train.json": b"{}",
    "data/lego/train/r_0.png": b"picture",
    "data/ship/transforms_train.json": b"[]",
    "__MACOSX/data/lego/transforms_train.json": b"resource fork",
}


def published(name: str, **entries: Any) -> PublishedScene:
    """A scene of a collection with some entries."""
    words = {"page": "https://a", "licence": "", "data": "inward", "learn": "", "url": "https://a"}
    return PublishedScene(name, "", Collection(**{**words, **entries}, scenes={name: ""}))


def lego(folder: str | None = "lego") -> PublishedScene:
    """A scene that is published in an archive."""
    return published("lego", folder=folder)


def written(work: Path, files: dict[str, bytes]) -> Path:
    """An archive of files where a download leaves it."""
    archive = work / "files" / "archive"
    archive.parent.mkdir(parents=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
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


def damaged(compression: int) -> bytes:
    """An archive in which what is packed is altered."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", compression) as packed:
        packed.writestr("a.json", bytes(range(256)) * 9)
    packed_at = 30 + len("a.json")
    return content.getvalue()[:packed_at] + b"\xff" * 40 + content.getvalue()[packed_at + 40 :]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"<html>not an archive</html>", "cannot be unpacked"),
        (damaged(zipfile.ZIP_LZMA), "cannot be unpacked"),
        (damaged(zipfile.ZIP_BZIP2), "cannot be unpacked"),
        (None, "holds no hotdog with"),
    ],
)
def test_another_file_than_expected_is_refused(tmp_path, content, said):
    archive = written(tmp_path, FILES)
    if content is not None:
        archive.write_bytes(content)
    with pytest.raises(DevrfError, match=said):
        _unpacked(lego("hotdog"), tmp_path)


def test_an_archive_that_expands_beyond_what_scenes_do_is_not_unpacked(tmp_path):
    # 100 MB of zeros in 100 kB; 20,000 empty files; 300 empty files in 60 folders each.
    for files, said in (
        ({"lego/train/r_0.png": bytes(100_000_000)}, r"its 9\d\.\d kB would become 100\.0 MB"),
        ({f"lego/{k}": b"" for k in range(20_000)}, r"MB would become 163\.8 MB"),
        ({f"{k}/{'a/' * 60}": b"" for k in range(300)}, r"kB would become 7\d\.\d MB"),
    ):
        shutil.rmtree(tmp_path / "files", ignore_errors=True)
        written(tmp_path, {"lego/transforms_train.json": b"{}", **files})
        with pytest.raises(DevrfError, match=said):
            _unpacked(lego(), tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["files"]


def test_an_archive_that_lists_any_number_of_files_is_not_opened(tmp_path):
    archive = written(tmp_path, {"a": b""})
    content = archive.read_bytes()
    at, end = content.find(b"PK\1\2"), content.find(b"PK\5\6")
    times = 2**26 // (end - at) + 1
    sizes = (times * (end - at)).to_bytes(4, "little")
    whole = content[:at] + content[at:end] * times + content[end : end + 12] + sizes
    archive.write_bytes(whole + content[end + 16 :])
    with pytest.raises(DevrfError, match="it lists too many files"):
        _unpacked(lego(), tmp_path)


def test_an_archive_of_folders_in_one_another_is_refused(tmp_path):
    written(tmp_path, {f"lego/{'a/' * count}f": b"" for count in (800, 1600)})
    with pytest.raises(DevrfError, match=r"archive: cannot be unpacked \(more than 64 folders in"):
        _unpacked(lego(), tmp_path)


@pytest.fixture
def trickle() -> Iterator[str]:
    """The address of a server that sends a part at once, then a byte now and then, for a minute.

    ``/moved`` leads elsewhere, ``/busy`` asks to be asked later, ``/slow`` sends headers alone.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:  # noqa: N802
            assert self.headers["Accept-Encoding"] == "identity"
            code, header, said = {
                "/moved": (302, "Location", "/there"),
                "/busy": (503, "Retry-After", "30"),
            }.get(self.path, (200, "Server", ""))
            if self.path == "/slow":
                self.wfile.write(b"HTTP/1.0 200 OK\r\n")
            self.send_response(code)
            self.send_header(header, said)
            if self.path != "/slow":
                self.end_headers()
            with suppress(OSError):
                self.wfile.write(bytes(2000) if self.path != "/slow" else b"X: ")
                for _ in range(1200):
                    self.wfile.write(b"x")
                    time.sleep(0.05)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize(
    ("path", "limit", "said"),
    [
        ("lego.zip", {"LONGEST": 0.4}, "it comes too slowly"),
        ("lego.zip", {"LARGEST": 1000}, "more than 1.0 kB came"),
        ("moved", {"LONGEST": 0.4}, "it comes too slowly"),
        ("slow", {"STALLED": 1.0}, "it comes too slowly"),
        ("busy", {}, "503 .*"),
    ],
)
def test_a_download_without_end_is_ended(tmp_path, monkeypatch, trickle, path, limit, said):
    for name, value in limit.items():
        monkeypatch.setattr(f"devrf.apps.fetch.{name}", value)
    scene = published("lego", url=f"{trickle}/{path}")
    began = time.monotonic()
    with pytest.raises(DevrfError, match=rf"/{path}: cannot be fetched \({said}\)"):
        fetched(scene, FetchSettings(tmp_path), progress=False)
    assert time.monotonic() - began < 20 and not (tmp_path / "lego").exists()


def test_a_download_that_is_interrupted_leaves_no_part(tmp_path, monkeypatch, trickle):
    def interrupted(self: object, seconds: float) -> None:
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr("multiprocessing.pool.ApplyResult.wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fetched(
            published("lego", url=f"{trickle}/lego.zip"), FetchSettings(tmp_path), progress=False
        )
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["lock"]


def test_a_file_in_an_archive_that_holds_more_than_is_said_is_not_unpacked(tmp_path):
    archive = written(tmp_path, {"lego/transforms_train.json": b"{}", "lego/a.png": bytes(5000)})
    content = bytearray(archive.read_bytes())
    for place in (content.find(b"lego/a.png") - 30 + 22, content.rfind(b"lego/a.png") - 46 + 24):
        assert content[place : place + 4] == (5000).to_bytes(4, "little")
        content[place : place + 4] = (10).to_bytes(4, "little")
    archive.write_bytes(content)
    with pytest.raises(DevrfError, match="cannot be unpacked"):
        _unpacked(lego(), tmp_path)
