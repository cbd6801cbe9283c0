"""A page's server answers requests of the page that it gave out, and no others."""

from __future__ import annotations

import socket
from collections.abc import Callable, Collection
from contextlib import suppress
from urllib.parse import urlsplit


def own_names(host: str) -> frozenset[str]:
    """The names by which a page on ``host`` may be opened, beside IP addresses."""
    names = ("localhost", host, socket.gethostname(), socket.getfqdn())
    return frozenset(name.lower() for name in names)


def refusal(header: Callable[[str, str], str], names: Collection[str]) -> str | None:
    """Why a request is not answered; None: it is.

    ``header(name, default)`` gives a header of the request.

    A page from elsewhere that the same browser shows gives its own address in ``Origin``, or its
    browser says ``Sec-Fetch-Site: cross-site``. One whose name was made to lead to this machine
    (DNS rebinding) gives that name in ``Host``: an IP address or one of the machine's own ``names``
    cannot be made so.
    """
    host = header("Host", "").lower()
    name = host
    with suppress(ValueError):
        name = urlsplit(f"//{host}").hostname or ""
    is_address = ":" in name or name.replace(".", "").isdecimal()
    if name not in names and not is_address:
        return f"devrf: this machine is not {name!r}; open the page by its IP address\n"
    origin = header("Origin", f"http://{host}").lower().partition("://")[2]
    if origin != host or header("Sec-Fetch-Site", "") == "cross-site":
        return "devrf: another page's request; type the address of this one\n"
    return None
