"""Files over HTTP: whole or not at all, and gone on with where they broke off."""

from __future__ import annotations

import pytest

from devrf.errors import DevrfError
from devrf.system.download import download, remote_size

CONTENT = bytes(range(256)) * 40
HALF = len(CONTENT) // 2


@pytest.fixture
def file(web):
    web.files["/a.zip"] = CONTENT
    return f"{web.address}/a.zip"


def ignore(done: int) -> None:
    pass


def test_a_file_comes_whole_and_alone(web, file, tmp_path):
    told: list[int] = []
    download(file, tmp_path / "a.zip", told.append)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert told[0] == 0 and told[-1] == len(CONTENT) == remote_size(file)
    assert [path.name for path in tmp_path.iterdir()] == ["a.zip"]


def test_a_file_that_is_there_is_not_fetched_again(web, file, tmp_path):
    (tmp_path / "a.zip").write_bytes(b"here")
    download(file, tmp_path / "a.zip", ignore)
    assert (tmp_path / "a.zip").read_bytes() == b"here" and not web.asked


def test_a_broken_connection_is_taken_up_where_it_broke(web, file, tmp_path):
    web.cuts["/a.zip"] = [HALF]
    download(file, tmp_path / "a.zip", ignore)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert [asked for _, _, asked in web.asked] == [None, f"bytes={HALF}-"]


def test_a_later_command_goes_on(web, file, tmp_path):
    web.cuts["/a.zip"] = [HALF, 0]
    with pytest.raises(DevrfError, match="broke off at .* the same command goes on"):
        download(file, tmp_path / "a.zip", ignore)
    assert not (tmp_path / "a.zip").exists()
    download(file, tmp_path / "a.zip", ignore)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert web.asked[-1][2] == f"bytes={HALF}-"


def test_a_file_that_has_changed_is_fetched_from_its_beginning(web, file, tmp_path):
    web.cuts["/a.zip"] = [HALF, 0]
    with pytest.raises(DevrfError):
        download(file, tmp_path / "a.zip", ignore)
    web.files["/a.zip"] = CONTENT[::-1]
    download(file, tmp_path / "a.zip", ignore)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT[::-1]


def test_a_server_without_versions_gives_the_whole_again(web, file, tmp_path):
    web.remembers = False
    web.cuts["/a.zip"] = [HALF]
    download(file, tmp_path / "a.zip", ignore)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert [asked for _, _, asked in web.asked] == [None, None]


def test_an_address_that_moved_is_said(web, tmp_path):
    gone = f"{web.address}/gone"
    for ask in (remote_size, lambda url: download(url, tmp_path / "b", ignore)):
        with pytest.raises(DevrfError, match="/gone: the server answers 404"):
            ask(gone)
    assert not list(tmp_path.iterdir())


def test_no_network_is_said(tmp_path):
    with pytest.raises(DevrfError, match=r"cannot be fetched \(.*see that the network works"):
        download("http://127.0.0.1:9/a.zip", tmp_path / "a.zip", ignore)
    assert not list(tmp_path.iterdir())
