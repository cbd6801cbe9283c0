"""Where the viewer listens; what it refuses, in one line."""

from __future__ import annotations

import socket

import pytest

from devrf.apps.settings import ViewerSettings
from devrf.errors import DevrfError


def test_it_listens_on_this_machine_alone_unless_told_otherwise():
    assert ViewerSettings().host == "127.0.0.1"
    assert ViewerSettings().address == "http://127.0.0.1:8080"


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"port": 0}, "viewer.port: expected 1 to 65535, not 0"),
        ({"port": 70000}, "viewer.port: expected 1 to 65535, not 70000"),
        ({"height": 3}, "viewer.height: expected 16 to 4096, not 3"),
        ({"move_seconds": 0}, "viewer.move_seconds: "),
        ({"share": 2}, "viewer.share: "),
    ],
)
def test_settings_that_cannot_be(keys, expected):
    with pytest.raises(DevrfError) as error:
        ViewerSettings(**keys)
    assert str(error.value).startswith(expected)


def test_a_port_in_use():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(DevrfError, match=rf"^viewer\.port: {port} on 127\.0\.0\.1 is in use"):
            ViewerSettings(port=port).check_free()
    ViewerSettings(port=port).check_free()


@pytest.mark.parametrize("host", ["192.0.2.1", "no such host"])
def test_an_address_that_is_not_this_machines(host):
    with pytest.raises(DevrfError, match=r"^viewer\.host: cannot listen on") as error:
        ViewerSettings(host=host).check_free()
    assert "\n" not in str(error.value)
