"""The web server of the page."""

from __future__ import annotations

import contextlib
import io
import logging
from typing import Any

import viser

from devrf.apps.viewer.settings import ViewerSettings
from devrf.errors import DevrfError


def set_value(control: Any, value: object) -> None:
    """Set what a control of the page shows; its type takes it for read-only."""
    control.value = value


def open_server(settings: ViewerSettings) -> viser.ViserServer:
    """A server at the address of the settings; the caller stops it.

    Raises:
        DevrfError: the address is in use, or not this machine's.
    """
    settings.check_free()
    logging.getLogger("websockets").setLevel(logging.WARNING)
    with quiet():
        server = viser.ViserServer(settings.host, settings.port, label="devrf", verbose=False)
    if server.get_port() != settings.port:  # it takes the next one that is free
        stop_server(server)
        raise DevrfError(
            f"viewer.port: {settings.port} on {settings.host} is in use by another program; "
            "give another"
        )
    # Its share button would give the page to a server elsewhere.
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # beside the picture, not on it
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Take a server from the network."""
    with quiet():
        server.stop()


def quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """A block in which the server prints no banner."""
    return contextlib.redirect_stdout(io.StringIO())
