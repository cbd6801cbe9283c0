"""The page in a real browser: the slider is moved, and the picture changes."""

from __future__ import annotations

import io
import shutil
import socket
import threading
import time

import numpy as np
import pytest
from PIL import Image

from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.drawing import Drawing
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.rendering.renderer import Renderer

pytest.importorskip("viser", reason="the viewer's extra is not installed")
webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
# Without a GPU Chromium draws by SwiftShader.
OPTIONS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=700,400"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
# A busy machine may take long to start a browser.
PATIENCE = 120


@pytest.fixture
def browser():
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("no chromium and chromedriver on this machine")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for one in OPTIONS:
        options.add_argument(one)
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


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


def canvas(browser):
    """The left half of the page, where no control is."""
    shot = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
    return np.asarray(shot)[150:, : shot.width // 2].astype(int)


def test_the_slider_moves_time_and_the_picture_changes(session, browser):
    by, keys = webdriver.common.by.By, webdriver.common.keys.Keys
    browser.get(session.settings.address)
    wait_for(lambda: session.frames > 0 and len(np.unique(canvas(browser))) > 40)
    before, shown = canvas(browser), session.frames
    browser.find_element(by.CSS_SELECTOR, "[role=slider]").send_keys(keys.END)
    wait_for(lambda: session.controls.playback.time == 1.0 and session.frames > shown)
    wait_for(lambda: bool((np.abs(canvas(browser) - before) > 30).any()))
    changed = (np.abs(canvas(browser) - before).max(axis=-1) > 30).mean()
    assert changed > 0.005  # everything has moved by up to 5 % of its box
