"""The page in a real browser: the slider is moved, and the picture changes."""

from __future__ import annotations

import io
import socket
import threading
import time

import numpy as np
import pytest
from PIL import Image

from browser import PATIENCE
from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.drawing import Drawing
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.rendering.renderer import Renderer

pytest.importorskip("viser", reason="the viewer's extra is not installed")


@pytest.fixture
def session(moving, tiny_scene, tmp_path):
    """The tiny scene, served by another thread."""
    from devrf.apps.viewer.session import Session

    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    settings = ViewerSettings(port=port, height=48)
    served = Session(settings, Viewpoints.of(tiny_scene), tiny_scene, tmp_path)
    served.present(Drawing(Renderer(moving, times=6), 1.0))
    thread = threading.Thread(target=served.serve, daemon=True)
    thread.start()
    yield served
    served.stop()
    thread.join(10)
    served.close()
    assert not thread.is_alive()


def wait_for(true):
    until = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < until
        time.sleep(0.1)


def canvas(driver):
    """The left half of the page, where no control is."""
    shot = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
    return np.asarray(shot)[150:, : shot.width // 2].astype(int)


def test_the_slider_moves_time_and_the_picture_changes(session, browser):
    keys = pytest.importorskip("selenium.webdriver.common.keys").Keys
    browser.open(session.settings.address, 700, 400)
    driver = browser.driver
    wait_for(lambda: session.frames > 0 and len(np.unique(canvas(driver))) > 40)
    before, shown = canvas(driver), session.frames
    driver.find_element("css selector", "[role=slider]").send_keys(keys.END)
    wait_for(lambda: session.controls.playback.time == 1.0 and session.frames > shown)
    wait_for(lambda: bool((np.abs(canvas(driver) - before) > 30).any()))
    changed = (np.abs(canvas(driver) - before).max(axis=-1) > 30).mean()
    assert changed > 0.005  # everything has moved by up to 5 % of its box
