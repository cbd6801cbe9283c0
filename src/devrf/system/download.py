"""Files over HTTP, gone on with where they broke off."""

from __future__ import annotations

import ssl
from collections.abc import Callable
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from devrf.errors import DevrfError

CHUNK = 1 << 20
# Seconds without an answer.
TIMEOUT = 30
# A connection that breaks is taken up again so often, as long as something comes.
ATTEMPTS = 5
# Some servers refuse the name that Python gives itself.
AGENT = {"User-Agent": "devrf"}
# What a network does; errors of the disk are not among them.
BROKEN = (URLError, HTTPException, TimeoutError, ConnectionError, ssl.SSLError)


def remote_size(url: str) -> int | None:
    """The size of a file in bytes, without fetching it; None where the server does not say.

    Raises:
        DevrfError: the server cannot be reached, or has no such file.
    """
    try:
        with urlopen(Request(url, headers=AGENT, method="HEAD"), timeout=TIMEOUT) as response:
            return _length(response)
    except HTTPError as error:
        if error.code in (404, 410):
            raise _failure(url, error) from None
        return None  # it may answer no HEAD
    except BROKEN as error:
        raise _failure(url, error) from None


def download(url: str, path: Path, progress: Callable[[int], None]) -> None:
    """Fetch ``url`` to ``path``, which appears when it is whole.

    What came so far is kept beside it, ``<name>.part``, and gone on with, if the server can and
    still has the same file.

    Args:
        url: what to fetch.
        path: where to; its folder exists. A file there is kept.
        progress: is told how many bytes there are, again and again.

    Raises:
        DevrfError: the server cannot be reached, or does not give the file.
    """
    if path.is_file():
        progress(path.stat().st_size)
        return
    part = path.with_name(f"{path.name}.part")
    for attempt in range(1, ATTEMPTS + 1):
        before = _size(part)
        try:
            _transfer(url, part, progress)
            break
        except BROKEN as error:
            again = not isinstance(error, HTTPError) and _size(part) > before
            if not again or attempt == ATTEMPTS:
                raise _failure(url, error) from None
    part.replace(path)
    _version_file(part).unlink(missing_ok=True)


def _transfer(url: str, part: Path, progress: Callable[[int], None]) -> None:
    """Fetch ``url``, or what is missing of it, to the end of ``part``."""
    headers, done = dict(AGENT), _size(part)
    version = _version_file(part)
    if done and version.is_file():
        headers |= {"Range": f"bytes={done}-", "If-Range": version.read_text()}
    with urlopen(Request(url, headers=headers), timeout=TIMEOUT) as response:
        if response.status != 206:  # all of it comes
            done = 0
            _remember_version(response, version)
        length = _length(response)
        total = None if length is None else done + length
        with part.open("ab" if done else "wb") as file:
            progress(done)
            while chunk := response.read(CHUNK):
                file.write(chunk)
                done += len(chunk)
                progress(done)
    if total is not None and done < total:
        raise ConnectionError(f"it broke off at {done} of {total} bytes")


def _remember_version(response: HTTPResponse, file: Path) -> None:
    """Keep by what the server knows this version of the file: only that may be gone on with."""
    tag = response.headers.get("ETag", "")
    known = response.headers.get("Last-Modified", "") if tag.startswith("W/") or not tag else tag
    if known:
        file.write_text(known)
    else:
        file.unlink(missing_ok=True)


def _version_file(part: Path) -> Path:
    return part.with_name(f"{part.name}.version")


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _length(response: HTTPResponse) -> int | None:
    length = response.headers.get("Content-Length", "")
    return int(length) if length.isdecimal() else None


def _failure(url: str, error: Exception) -> DevrfError:
    if isinstance(error, HTTPError):
        return DevrfError(
            f"{url}: the server answers {error.code} {error.reason}; it may have moved: see "
            "whether its page names another address"
        )
    why = error.reason if isinstance(error, URLError) else error
    return DevrfError(
        f"{url}: cannot be fetched ({why or type(error).__name__}); see that the network works; "
        "the same command goes on where it stopped"
    )
