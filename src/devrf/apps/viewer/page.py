"""Serves the page of a scene, which a browser draws by itself, and its cameras' pictures.

A run's ``export/`` has both: ``scene.html``, which says which checkpoint it shows, and
``pictures/``. So a page that shows the run's last checkpoint is served before torch has loaded.
"""

from __future__ import annotations

import base64
import hashlib
import logging
import re
import sys
import threading
from functools import cache, partial
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any, BinaryIO

from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.guard import own_names, refusal
from devrf.checkpoints.file_metadata import digest_of, latest_checkpoint
from devrf.system.files import read_record

log = logging.getLogger(__name__)

PAGE = "scene.html"
PICTURES = "pictures"
# Bytes of a page at most, and at its start with its description.
LARGEST = 2**28
START = 2000
# Served paths.
SERVED = re.compile(r"/(scene\.html|pictures/\w{1,80}/\d{1,9}\.jpg)", re.ASCII)
# Seconds in which a client has to send a part of its request, and to take 64 KB of the answer.
PATIENCE = 10.0


def is_current(run: Path) -> bool:
    """Whether a run's ``export/`` has the page of its newest checkpoint, and pictures for it.

    It has to have the program of this version of devrf, and the checkpoint of a finished stage.
    """
    folder = run / "export"
    try:
        newest = latest_checkpoint(run)
        page = read_record(folder / PAGE, LARGEST)
        digest = "" if newest is None or "-progress-" in newest.name else digest_of(newest)
    except (OSError, ValueError):  # none is there, or another process has just removed it
        return False
    whole = digest != "" and (folder / PICTURES).is_dir()
    programs = _source("scene.js").encode(), _source("scene.glsl").encode()
    return whole and digest.encode() in page[:START] and all(text in page for text in programs)


@cache
def _source(name: str) -> str:
    return files("devrf.apps.web").joinpath(name).read_text("utf-8")


@cache
def _policy() -> str:
    """The page's content security policy: a foreign file runs no program but devrf's own."""
    program = hashlib.sha256(f"\n{_source('scene.js')}\n".encode()).digest()
    own = f"script-src 'sha256-{base64.b64encode(program).decode()}'"
    alone = "frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
    return f"default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; {own}; {alone}"


class PageServer:
    """A server of a folder that has a page and its pictures, until it is closed."""

    def __init__(self, settings: ViewerSettings, folder: Path) -> None:
        """Answer at the address of the settings.

        Raises:
            DevrfError: the address is in use, or not this machine's.
        """
        settings.check_free()
        self.settings = settings
        self._stop = threading.Event()
        handler = partial(_Handler, directory=str(folder.resolve()), names=own_names(settings.host))
        self._server = _Server(settings, handler, self._stop)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def serve(self) -> None:
        """Wait for :meth:`stop`."""
        log.info("the scene is at %s; Ctrl-C ends the viewer", self.settings.address)
        self._stop.wait()
        log.info("the viewer has ended")

    def stop(self) -> None:
        """End :meth:`serve`; a signal's handler may call it."""
        self._stop.set()

    def close(self) -> None:
        """Take the page from the network."""
        self.stop()
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    request_queue_size = 64  # clients that wait, and that are answered, at one time

    def __init__(self, settings: ViewerSettings, handler: Any, stop: threading.Event) -> None:
        self._places = threading.BoundedSemaphore(self.request_queue_size)
        self._stop = stop
        self.address_family = settings.family
        super().__init__((settings.host, settings.port), handler)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether a client is answered, once others are: each may send megabytes of headers."""
        tries = range(round(10 * PATIENCE))
        return any(self._places.acquire(timeout=0.1) for _ in tries if not self._stop.is_set())

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a client in a thread of its own; without one its place is free again."""
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread can be started
            self._places.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a client, and make its place free."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that has gone away, or is too slow."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(SimpleHTTPRequestHandler):
    """Answers requests for the page and its pictures, from this machine's own pages."""

    timeout = PATIENCE

    def __init__(self, *request: Any, names: frozenset[str], directory: str) -> None:
        self.names = names
        super().__init__(*request, directory=directory)

    def send_head(self) -> BinaryIO | None:
        path = self.path.partition("?")[0]
        file = Path(self.directory + path)
        why = refusal(self.headers.get, self.names)
        if why is not None:
            self.send_error(HTTPStatus.FORBIDDEN, explain=why.strip())
        elif path == "/":  # tells the page that pictures are to be had
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", f"/{PAGE}?{PICTURES}")
            self.send_header("Content-Length", "0")
            self.end_headers()
        elif SERVED.fullmatch(path) and file.is_file() and file.resolve() == file:  # no link, pipe
            del self.headers["If-Modified-Since"]  # by another run's page at the same address
            return super().send_head()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)
        return None

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", _policy())
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        super().end_headers()

    def log_message(self, format: str, *arguments: object) -> None:
        """Say nothing: requests are no news."""
