"""The page's server: it answers the page that it gave out, and no other."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from functools import partial
from http import HTTPStatus
from typing import Any
from unittest.mock import patch
from urllib.parse import urlsplit

import viser
from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from devrf.apps.settings import ViewerSettings


def open_server(settings: ViewerSettings) -> viser.ViserServer:
    """A server at the address of the settings, if it is free, with an empty page."""
    settings.check_free()
    logging.getLogger("websockets").setLevel(logging.WARNING)
    # A probe of the port asks for no page: its traceback would help nobody.
    logging.getLogger("websockets.server").addFilter(lambda r: r.msg != "opening handshake failed")
    names = {"localhost", settings.host, socket.gethostname(), socket.getfqdn()}
    serve = partial(_guarded, websockets_server.serve, {name.lower() for name in names})
    # viser has no setting for a check of requests.
    with quiet(), patch.object(websockets_server, "serve", serve):
        server = viser.ViserServer(settings.host, settings.port, label="devrf", verbose=False)
    # Its share button would give the page to a server elsewhere.
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # beside the frame, not on it
    return server


def quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """A block in which the server prints no banner."""
    return contextlib.redirect_stdout(io.StringIO())


def _guarded(serve: Any, names: set[str], *where: Any, process_request: Any, **more: Any) -> Any:
    """``serve``, which refuses pages from elsewhere that the same browser shows.

    Such a page gives its own address in ``Origin``. One whose name was made to lead to this machine
    (DNS rebinding) gives that name in ``Host``: an IP address or one of the machine's own ``names``
    cannot be made so.
    """

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        host = request.headers.get("Host", "").lower()
        name = urlsplit(f"//{host}").hostname or ""
        is_address = ":" in name or name.replace(".", "").isdigit()
        if name not in names and not is_address:
            why = f"this machine is not {name!r}; open the page by its IP address"
        elif urlsplit(request.headers.get("Origin", f"//{host}")).netloc.lower() != host:
            why = "another page's request"
        else:
            response: Response | None = process_request(connection, request)
            return response
        return connection.respond(HTTPStatus.FORBIDDEN, f"devrf: {why}\n")

    return serve(*where, process_request=answer, **more)
