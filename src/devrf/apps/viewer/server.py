"""The page's server: it answers the page that it gave out, and no other."""

from __future__ import annotations

import contextlib
import io
import logging
from functools import partial
from http import HTTPStatus
from typing import Any
from unittest.mock import patch

import viser
from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.guard import own_names, refusal


def open_server(settings: ViewerSettings) -> viser.ViserServer:
    """A server at the address of the settings, if it is free, with an empty page."""
    settings.check_free()
    logging.getLogger("websockets").setLevel(logging.WARNING)
    # A probe of the port asks for no page: its traceback would help nobody.
    logging.getLogger("websockets.server").addFilter(lambda r: r.msg != "opening handshake failed")
    serve = partial(_guarded, websockets_server.serve, own_names(settings.host))
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


def _guarded(
    serve: Any, names: frozenset[str], *where: Any, process_request: Any, **more: Any
) -> Any:
    """``serve``, which refuses what :func:`refusal` says."""

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        why = refusal(request.headers.get, names)
        if why is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, why)
        response: Response | None = process_request(connection, request)
        return response

    return serve(*where, process_request=answer, **more)
