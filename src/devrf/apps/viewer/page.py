"""Serves the page of a scene, which a browser draws by itself, and its cameras' pictures.

A run's ``export/`` has both: ``scene.html``, which says which checkpoint it shows, and
``pictures/``. So a page that shows the run's last checkpoint is served before torch has loaded.
"""

from __future__ import annotations

import logging
import threading
from functools import partial
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import BinaryIO

from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.guard import own_names, refusal
from devrf.checkpoints.file_metadata import digest_of

log = logging.getLogger(__name__)

PAGE = "scene.html"
PICTURES = "pictures"
# Bytes of a page in which it says what it shows.
START = 2000


def is_current(run: Path) -> bool:
    """Whether a run's ``export/`` has the page of its newest checkpoint, and pictures for it."""
    page = run / "export" / PAGE
    checkpoints = sorted(run.glob("checkpoints/*.ckpt"), key=lambda path: path.stat().st_mtime_ns)
    if not checkpoints or not page.is_file() or not (page.parent / PICTURES).is_dir():
        return False
    digest = digest_of(checkpoints[-1])
    with page.open("rb") as file:
        return digest != "" and digest.encode() in file.read(START)


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
        handler = partial(_Handler, directory=str(folder), names=own_names(settings.host))
        self._server = ThreadingHTTPServer((settings.host, settings.port), handler)
        self._server.daemon_threads = True
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
        self._server.shutdown()
        self._server.server_close()


class _Handler(SimpleHTTPRequestHandler):
    """Answers the page's own requests, by the files of the folder."""

    def __init__(self, *request: object, names: frozenset[str], directory: str) -> None:
        self.names = names
        super().__init__(*request, directory=directory)  # type: ignore[arg-type]

    def send_head(self) -> BinaryIO | None:
        why = refusal(self.headers.get, self.names)
        if why is not None:
            self.send_error(HTTPStatus.FORBIDDEN, why)
        elif self.path == "/":  # tells the page that pictures are to be had
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", f"/{PAGE}?{PICTURES}")
            self.send_header("Content-Length", "0")
            self.end_headers()
        else:
            return super().send_head()
        return None

    def list_directory(self, path: object) -> None:
        self.send_error(HTTPStatus.NOT_FOUND)

    def log_message(self, format: str, *arguments: object) -> None:
        """Say nothing: requests are no news."""
