"""stage=fetch puts a published scene in its place, whole and checked, or says why not."""

from __future__ import annotations

import hashlib
import io
import json
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from filelock import FileLock

PICTURE = b"not really a picture" * 500

FILES = """
[[collection]]
page = "https://example.org/fox"
licence = "anyone's"
data = "nerfstudio"
learn = "experiment=cpu_small"
url = "{address}/fox/{{file}}"
files = ["transforms.json", "images/0001.jpg"]
scenes.fox = "a fox"
"""
ARCHIVE = """
[[collection]]
page = "https://example.org/blender"
licence = "anyone's"
data = "inward"
learn = "experiment=cpu_small"
url = "{address}/{{scene}}.zip"
scenes.lego = "a digger"
[collection.sha256]
lego = "{sha256}"
"""


@dataclass
class Web:
    """A server on this machine.

    Attributes:
        address: of the server, without a slash at the end.
        files: what it serves, by path.
        cuts: after how many bytes the connection breaks, for each request in turn, by path.
        asked: the path of each request.
    """

    address: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    cuts: dict[str, list[int]] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)


@pytest.fixture
def web() -> Iterator[Web]:
    """A server of a test's own files."""
    served = Web()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:  # noqa: N802
            served.asked.append(self.path)
            content, cuts = served.files[self.path], served.cuts.get(self.path, [])
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[: cuts.pop(0)] if cuts else content)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        served.address = f"http://127.0.0.1:{server.server_port}"
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield served
        server.shutdown()


@pytest.fixture
def published(web, tmp_path):
    """Two scenes on a server, and a catalogue of them; the arguments that name it."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("lego/transforms_train.json", "{}")
        archive.writestr("lego/train/r_0.png", PICTURE)
    web.files["/lego.zip"] = packed.getvalue()
    web.files["/fox/transforms.json"] = b"{}"
    web.files["/fox/images/0001.jpg"] = PICTURE
    digest = hashlib.sha256(packed.getvalue()).hexdigest()
    text = FILES.format(address=web.address) + ARCHIVE.format(address=web.address, sha256=digest)
    (tmp_path / "mine.toml").write_text(text)
    return ("stage=fetch", "fetch.catalogue=mine.toml")


def record(folder):
    return json.loads((folder / "fetched.json").read_text())


def test_single_files_are_fetched_and_their_checksum_is_kept(devrf, tmp_path, published):
    outcome = devrf(*published, "scene=fox")
    assert (outcome.status, outcome.err) == (0, "")
    fox = tmp_path / "scenes" / "fox"
    assert (fox / "images" / "0001.jpg").read_bytes() == PICTURE
    # What `sha256sum images/0001.jpg transforms.json | sha256sum` prints.
    lines = f"{hashlib.sha256(PICTURE).hexdigest()}  images/0001.jpg\n"
    lines += f"{hashlib.sha256(b'{}').hexdigest()}  transforms.json\n"
    digest = hashlib.sha256(lines.encode()).hexdigest()
    assert record(fox)["sha256"] == digest and record(fox)["compared"] is False
    assert f"SHA-256 {digest}: none was known to compare it with" in outcome.out
    assert "python -m devrf stage=inspect data.root=scenes/fox" in outcome.out
    assert {path.name for path in (tmp_path / "scenes").iterdir()} == {"fox"}
    again = devrf(*published, "scene=fox")
    assert again.status == 0 and "is in scenes/fox already" in again.out
    assert devrf(*published, "scene=fox", "fetch.into=b", f"fetch.sha256={digest}").status == 0
    assert record(tmp_path / "b" / "fox")["compared"] is True


def test_an_archive_is_unpacked_if_its_checksum_is_as_expected(devrf, web, tmp_path, published):
    whole = web.files["/lego.zip"]
    web.files["/lego.zip"] = whole + b"changed"
    outcome = devrf(*published, "scene=lego")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "what came has the SHA-256" in outcome.err and "expected" in outcome.err
    assert not (tmp_path / "scenes" / "lego").exists()
    assert not list(tmp_path.rglob("archive"))
    web.files["/lego.zip"] = whole
    outcome = devrf(*published, "scene=lego", "fetch.into=my scenes (1)")
    assert (outcome.status, outcome.err) == (0, "")
    lego = tmp_path / "my scenes (1)" / "lego"
    files = {path.relative_to(lego).as_posix() for path in lego.rglob("*") if path.is_file()}
    assert files == {"transforms_train.json", "train/r_0.png", "fetched.json"}
    assert record(lego)["compared"] is True and "as expected" in outcome.out


def test_a_scene_that_another_process_fetches_is_left_to_it(devrf, web, tmp_path, published):
    lock = tmp_path / "scenes" / ".fox.fetch" / ".devrf" / "lock"
    lock.parent.mkdir(parents=True)
    with FileLock(lock):
        outcome = devrf(*published, "scene=fox")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert ".fox.fetch: another devrf process works in this folder" in outcome.err
    assert "or use fetch.into=FOLDER" in outcome.err and web.asked == []
    assert devrf(*published, "scene=fox").status == 0
    assert {path.name for path in (tmp_path / "scenes").iterdir()} == {"fox"}


def test_files_that_came_before_an_interruption_are_kept(devrf, web, tmp_path, published):
    web.cuts["/fox/images/0001.jpg"] = [4000]
    outcome = devrf(*published, "scene=fox")
    assert outcome.status == 2 and "0001.jpg: cannot be fetched" in outcome.err
    assert not (tmp_path / "scenes" / "fox").exists()
    web.asked.clear()
    assert devrf(*published, "scene=fox").status == 0
    assert web.asked == ["/fox/images/0001.jpg"]
    assert (tmp_path / "scenes" / "fox" / "images" / "0001.jpg").read_bytes() == PICTURE


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["scene=fxo"], "scene: stage=fetch knows no 'fxo'; choose one of fox, lego"),
        (["scene=fox", "fetch.catalogue=none.toml"], "fetch.catalogue: none.toml cannot be read"),
    ],
)
def test_one_line_for_a_mistake(devrf, tmp_path, published, arguments, expected):
    outcome = devrf(*published, *arguments)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert expected in outcome.err
    assert not (tmp_path / "outputs").exists()


def test_another_folder_in_its_place_is_left_alone(devrf, web, tmp_path, published):
    (tmp_path / "scenes" / "fox").mkdir(parents=True)
    outcome = devrf(*published, "scene=fox")
    assert outcome.status == 2
    assert "scenes/fox: there is something else, without fetched.json" in outcome.err
    assert not web.asked


@pytest.mark.parametrize("name", [".fox.fetch", ".fox.fetch/files", "fox"])
def test_nothing_is_fetched_through_a_link(devrf, web, tmp_path, published, name):
    (tmp_path / "scenes" / name).parent.mkdir(parents=True)
    (tmp_path / "scenes" / name).symlink_to(tmp_path / "else")
    if name != "fox":
        (tmp_path / "else").mkdir()
    outcome = devrf(*published, "scene=fox")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert f"scenes/{name}: " in outcome.err and not web.asked
    assert not (tmp_path / "else").exists() or not list((tmp_path / "else").iterdir())
