"""A browser without a window, and the pictures in its pages."""

from __future__ import annotations

import base64
import io
import math
import shutil
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
# Without a GPU Chromium draws by SwiftShader.
OPTIONS = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader")
OPTIONS += ("--enable-unsafe-swiftshader",)
# A busy machine may take long to start a browser, and to draw without a GPU.
PATIENCE = 120
# The canvas where its picture is finished, in one step: the next may be begun at once.
FINISHED = """
const whole = document.documentElement.dataset.quality === "full";
return whole ? document.getElementById("picture").toDataURL() : null;
"""


class Browser:
    """A browser with one page, whose canvas is as large as is asked for."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, address: str, width: int = 96, height: int = 72) -> None:
        """Open a page in a window of that size."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        self.driver.get("about:blank")
        self.driver.get_log("browser")  # forgets what was said before
        self.driver.get(address)

    def run(self, script: str) -> Any:
        """What a function's body returns in the page."""
        return self.driver.execute_script(script)

    def wait(self, script: str) -> None:
        """Wait until a condition holds in the page."""
        until = time.monotonic() + PATIENCE
        while not self.run(f"return {script}"):
            assert time.monotonic() < until, (script, self.said(), self.message)
            time.sleep(0.05)

    def canvas(self) -> torch.Tensor:
        """The finished picture (H, W, 3) in [0, 1]."""
        until = time.monotonic() + PATIENCE
        while (shown := self.run(FINISHED)) is None:
            assert time.monotonic() < until, (self.said(), self.message)
            time.sleep(0.05)
        return decoded(shown)

    def changed(self, before: torch.Tensor) -> torch.Tensor:
        """The finished picture once it differs from the one before."""
        until = time.monotonic() + PATIENCE
        while psnr(before, after := self.canvas()) >= 30:
            assert time.monotonic() < until, self.said()
        return after

    def picture(self) -> torch.Tensor:
        """What the canvas shows (H, W, 3) in [0, 1]."""
        return decoded(self.run("return document.getElementById('picture').toDataURL()"))

    @property
    def message(self) -> str:
        """What the page says in place of the picture."""
        return str(self.run("return document.getElementById('message')?.textContent"))

    def said(self) -> list[str]:
        """Errors and warnings in the page's console."""
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def element(self, name: str) -> Any:
        """A control of the page."""
        return self.driver.find_element("id", name)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("no chromium and chromedriver on this machine")
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for option in OPTIONS:
        options.add_argument(option)
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    yield Browser(driver)
    driver.quit()


def decoded(address: str) -> torch.Tensor:
    """The picture (H, W, 3) in [0, 1] that a data address holds."""
    picture = Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2])))
    return torch.from_numpy(np.asarray(picture.convert("RGB")) / 255.0)


def psnr(picture: torch.Tensor, truth: torch.Tensor) -> float:
    return -10 * math.log10(max(float((picture - truth).square().mean()), 1e-12))
