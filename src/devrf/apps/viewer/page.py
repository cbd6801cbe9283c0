"""Serves the page of a scene, which a browser draws by itself, and its cameras' pictures."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import PurePosixPath
from urllib.parse import urlsplit

import imageio.v3 as iio

from devrf.apps.captured_cameras import picture_of
from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.guard import own_names, refusal
from devrf.scenes.scene import Scene

log = logging.getLogger(__name__)


class PageServer:
    """A server of one page, from its making on, until it is closed."""

    def __init__(
        self, settings: ViewerSettings, page: str, scene: Callable[[], Scene | None]
    ) -> None:
        """Answer at the address of the settings.

        ``scene`` is called when pictures are first asked for; None: there are none.

        Raises:
            DevrfError: the address is in use, or not this machine's.
        """
        settings.check_free()
        self.settings = settings
        self._stop = threading.Event()
        handler = _handler(page.encode(), scene, own_names(settings.host))
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


def _handler(
    page: bytes, scene: Callable[[], Scene | None], names: frozenset[str]
) -> type[BaseHTTPRequestHandler]:
    """What answers the requests of one page."""
    lock = threading.Lock()

    @cache
    def picture(camera: str, frame: int) -> bytes | None:
        with lock:  # a scene is read once, and not by two threads
            seen = scene()
        pixels = None if seen is None else picture_of(seen, camera, frame)
        if pixels is None:
            return None
        encoded: bytes = iio.imwrite("<bytes>", pixels.numpy(), extension=".jpg", quality=90)
        return encoded

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:  # noqa: N802 - the name that http.server calls
            why = refusal(self.headers.get, names)
            where = urlsplit(self.path)
            if why is not None:
                self._send(HTTPStatus.FORBIDDEN, "text/plain", why.encode())
            elif self.path == "/":  # tells the page that pictures are to be had
                self.send_response(HTTPStatus.FOUND)
                self.send_header("Location", "/?pictures")
                self.send_header("Content-Length", "0")
                self.end_headers()
            elif where.path == "/":
                self._send(HTTPStatus.OK, "text/html; charset=utf-8", page)
            else:
                self._send_picture(PurePosixPath(where.path))

        def _send_picture(self, path: PurePosixPath) -> None:
            *folder, camera, file = ("", "", "", *path.parts)[-4:]
            frame, _, suffix = file.partition(".")
            data = None
            if folder[-1:] == ["pictures"] and suffix == "jpg" and frame.isdecimal():
                data = picture(camera, int(frame))
            if data is None:
                self._send(HTTPStatus.NOT_FOUND, "text/plain", b"devrf: no such picture\n")
            else:
                self._send(HTTPStatus.OK, "image/jpeg", data)

        def _send(self, status: HTTPStatus, kind: str, data: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, format: str, *arguments: object) -> None:
            """Say nothing: requests are no news."""

    return Handler
