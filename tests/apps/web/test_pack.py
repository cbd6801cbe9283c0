"""The page that browsers draw: pictures as the renderer's, controls that work, errors in words."""

from __future__ import annotations

import base64
import copy
import gzip
import html
import json
import math
import os
import re
import socket
import struct
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image

from browser import PATIENCE, psnr
from devrf.apps.captured_cameras import described, thumbnail, write_thumbnails
from devrf.apps.settings import ViewerSettings
from devrf.apps.still import still
from devrf.apps.viewer.page import PageServer
from devrf.apps.web.pack import page
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.cli.render import FRAME
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.model import DeVRFModel
from devrf.pictures.images import UNKNOWN
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene, background_value
from devrf.system.printed import shown

# The middle of a frustum that nothing covers.
CLICKABLE = """
for (const frustum of document.querySelectorAll("#frusta g:not([hidden]) polygon")) {
  const { left, right, top, bottom } = frustum.getBoundingClientRect();
  const middle = [Math.round((left + right) / 2), Math.round((top + bottom) / 2)];
  if (document.elementFromPoint(...middle) === frustum) return middle;
}
"""
LEAST_PSNR = 45.0
# Of scenes whose colours change from one grid point to the next, and with the direction.
LEAST_IN_HASTE = 23.0
ROWS = 54


def in_motion(rest: DeVRFModel, seed: int) -> DeVRFModel:
    """A model at rest, of which at the times 0.4 and 1 points have moved by up to 5 %."""
    model = copy.deepcopy(rest)
    box = model.space.inner(model.box)
    zero_outside_box = not model.space.is_linear
    clock = FrameClock((0.0, 0.4, 1.0))
    deformation = DeformationField(box, clock, voxels=5**3, zero_outside_box=zero_outside_box)
    shape = deformation.backward_slices[1:].shape
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor(box.size)
    deformation.backward_slices[1:] = 0.1 * size * (torch.rand(shape, generator=generator) - 0.5)
    model.deformation = deformation
    return model


@pytest.fixture
def scenes(
    moving: DeVRFModel,
    canonical: Callable[..., Any],
    fit: Callable[..., Any],
    serve: Callable[[Scene], Any],
    tiny_scene: Scene,
    tiny_toy: Scene,
    tiny_room: Scene,
) -> Callable[[str], tuple[DeVRFModel, Viewpoints]]:
    """``scenes(name)``: what was learned of a tiny scene, and its cameras."""

    def learned(name: str) -> tuple[DeVRFModel, Viewpoints]:
        scene = {"world": tiny_scene, "ndc": tiny_toy, "contracted": tiny_room}[name]
        if name == "world":
            return moving, Viewpoints.of(scene)
        stage = fit(canonical(visual_hull_init=False, iterations=60), data=serve(scene))
        model = in_motion(stage.scene_model, seed=1)
        features = model.canonical.color.values.data
        features += 3 * torch.randn(features.shape, generator=torch.Generator().manual_seed(2))
        model.canonical.decoder.output.weight.data *= 10  # colours that differ after so few steps
        return model, Viewpoints.of(scene)

    return learned


def link(camera: Cameras, time: float) -> str:
    """The part of an address that says where the page's camera is."""
    pose = ",".join(map(repr, camera.camera_to_world[0].flatten().tolist()))
    fov = math.degrees(2 * math.atan(camera.height / 2 / float(camera.focal[0, 1])))
    away = torch.tensor([camera.width, camera.height]) / 2 - camera.center[0]
    right, down = (away / camera.focal[0]).tolist()
    return f"#pose={pose}&distance=3&fov={fov!r}&middle={right!r},{-down!r}&time={time}"


@pytest.mark.parametrize("space", ["world", "ndc", "contracted"])
def test_a_browser_draws_what_the_renderer_does(browser, scenes, tmp_path, space):
    model, viewpoints = scenes(space)
    file = tmp_path / "a page.html"
    file.write_text(page(model, viewpoints, "tiny <scene>", "0123abcd"), encoding="utf-8")
    renderer = Renderer(model)
    behind = background_value(viewpoints.background)
    at_rest = renderer.view(viewpoints.held_out.of_height(ROWS), 0, 0.0, behind).color
    for camera, moment in (
        (viewpoints.dynamic[[0]], 0.4),  # a captured time
        (viewpoints.dynamic[[0]], 0.73),  # one between two
        (viewpoints.held_out, 1.0),  # another view
        (replace(viewpoints.static[[1]], center=torch.tensor([[8.0, 11.0]])), 0.0),  # off-centre
    ):
        camera = camera.of_height(ROWS)
        browser.open(file.as_uri() + link(camera, moment), camera.width, camera.height)
        picture = browser.canvas()
        truth = renderer.view(camera, 0, moment, behind).color.clamp(0, 1).view(picture.shape)
        assert truth.std() > 0.05
        assert psnr(picture, truth) >= LEAST_PSNR, moment
        assert browser.said() == []
    choice = pytest.importorskip("selenium.webdriver.support.select").Select
    choice(browser.element("channel")).select_by_visible_text("depth")
    _, depth = still(renderer, camera, moment, behind)
    picture = browser.changed(picture)
    assert psnr(picture, depth) >= LEAST_PSNR
    assert 255 * float((picture - depth).abs().quantile(0.9)) <= 1.01
    moved = renderer.view(viewpoints.held_out.of_height(ROWS), 0, 1.0, behind).color
    assert psnr(moved, at_rest) < LEAST_PSNR - 3  # the times do not all look the same
    # Previews: no picture is finished, and none may take time.
    text = file.read_text("utf-8").replace("SETTLED = 120", "SETTLED = 1e9")
    file.write_text(text.replace("BUDGET = 70", "BUDGET = 0"), "utf-8")
    browser.open(file.as_uri() + link(camera, moment), camera.width, camera.height)
    browser.wait("document.documentElement.dataset.quality === 'moving'")
    assert psnr(browser.picture(), truth) >= LEAST_IN_HASTE


def test_what_lies_behind_a_forward_facing_scene_is_empty_in_all_channels(
    browser, scenes, tmp_path
):
    choice = pytest.importorskip("selenium.webdriver.support.select").Select
    model, viewpoints = scenes("ndc")
    viewpoints = replace(viewpoints, background="black")
    camera = viewpoints.held_out.of_height(ROWS)
    turned = camera.camera_to_world[:, :, [2, 1, 0, 3]] * torch.tensor([-1.0, 1, 1, 1])
    camera = replace(camera, camera_to_world=turned)  # by a right angle to the side
    file = tmp_path / "scene.html"
    file.write_text(page(model, viewpoints, "tiny", "0123abcd"), encoding="utf-8")
    browser.open(file.as_uri() + link(camera, 0.4), camera.width, camera.height)
    picture = browser.canvas()
    color, depth = still(Renderer(model), camera, 0.4, background=0.0)
    assert psnr(picture, color) >= LEAST_PSNR
    channel = choice(browser.element("channel"))
    channel.select_by_visible_text("depth")
    picture = browser.changed(picture)
    assert psnr(picture, depth) >= LEAST_PSNR and (depth == 1).double().mean() > 0.4
    channel.select_by_visible_text("motion")
    motion = browser.changed(picture)
    behind = (color == 0).all(dim=-1)
    assert behind.double().mean() > 0.4
    assert (motion[behind] - UNKNOWN).abs().max() < 1 / 255


@pytest.mark.parametrize("rows", [72, 155])
@pytest.mark.parametrize("parts", [1, 2])
def test_an_enlarged_picture_has_no_line_at_its_edges(browser, file, rows, parts):
    text = file.read_text("utf-8").replace("SETTLED = 120", "SETTLED = 1e9")
    text = text.replace("BUDGET = 70", "BUDGET = 0").replace("MIN_ROWS = 72", f"MIN_ROWS = {rows}")
    file.write_text(text, "utf-8")
    browser.open(file.as_uri() + "#time=0.4", 500, 333)
    moving = f"document.documentElement.dataset.rows === '{rows}'"
    browser.wait(moving)
    if parts == 2:
        browser.run("document.documentElement.dataset.rows = ''")
        browser.element("rest").click()
        browser.wait(moving)
    picture = browser.picture()
    assert picture.shape == (333, 500, 3) and picture.std() > 0.05
    # Around the robot everything is white; what the device has beyond the picture is black.
    for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1]):
        assert edge.min() > 0.99


def test_a_served_page_runs_its_own_program_alone(browser, file, tiny_scene, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    write_thumbnails(tmp_path / "pictures", tiny_scene, Viewpoints.of(tiny_scene))
    text = file.read_text("utf-8")
    foreign = "<script>document.title = 'foreign'</script></body>"
    file.write_text(text.replace("</body>", foreign), "utf-8")
    served = PageServer(ViewerSettings(port=port), tmp_path)
    try:
        browser.open(f"http://127.0.0.1:{port}/", 360, 240)
        browser.wait("document.body.className === 'ready'")
        browser.element("cameras").click()
        browser.wait("document.querySelector('#frusta image[href^=pictures]') !== null")
        source = "document.querySelector('#frusta image[href^=pictures]').getAttribute('href')"
        loads = "const image = new Image(); image.onload = () => arguments[0](image.width);"
        loads += f"image.src = {source};"
        assert browser.driver.execute_async_script(loads) == 24
        assert browser.run("return document.title") == "tiny · devrf"
    finally:
        served.close()


@pytest.fixture
def file(moving: DeVRFModel, tiny_scene: Scene, tmp_path: Path) -> Path:
    """The page of the tiny scene in motion."""
    path = tmp_path / "scene.html"
    path.write_text(page(moving, Viewpoints.of(tiny_scene), "tiny", "0123abcd"), encoding="utf-8")
    return path


def test_the_controls_do_what_they_say(browser, file, tmp_path):
    actions = pytest.importorskip("selenium.webdriver.common.action_chains").ActionChains
    keys = pytest.importorskip("selenium.webdriver.common.keys").Keys
    choice = pytest.importorskip("selenium.webdriver.support.select").Select
    browser.open(file.as_uri(), 360, 130)  # each pixel takes its time here
    browser.wait("document.body.className === 'ready'")
    browser.wait("document.getElementById('clock').textContent > '0.05'")  # time runs
    browser.element("play").click()
    stands = browser.element("clock").text
    time.sleep(0.3)
    assert browser.element("clock").text == stands
    browser.element("time").send_keys(keys.END)
    assert browser.element("clock").text == "1.000"
    whole = browser.canvas()
    browser.element("rest").click()
    beside = browser.changed(whole)
    browser.element("rest").click()
    shown = browser.changed(beside)
    assert psnr(whole, shown) > 60
    channel = choice(browser.element("channel"))
    for word in ("depth", "motion"):
        channel.select_by_visible_text(word)
        shown = browser.changed(shown)
        assert psnr(whole, shown) < 30
    channel.select_by_visible_text("colour")
    shown = browser.changed(shown)
    assert psnr(whole, shown) > 60
    part = choice(browser.element("part"))
    part.select_by_visible_text("moving")  # the forward warp of this model moves nothing
    nothing = browser.changed(shown)
    assert float(nothing.std()) == 0
    part.select_by_visible_text("still")
    assert psnr(whole, browser.changed(nothing)) > 60
    assert browser.said() == []
    browser.open(file.as_uri() + "#time=1", 360, 240)  # in which hands and frusta have room
    browser.wait("document.body.className === 'ready'")

    def pose() -> str:
        browser.element("link").click()
        return str(browser.run("return location.hash"))

    picture = browser.element("picture")
    poses = [pose()]
    hand = actions(browser.driver)
    hand.move_to_element_with_offset(picture, 0, -60).click_and_hold()
    hand.move_by_offset(40, 10).release().perform()
    poses.append(pose())
    actions(browser.driver).key_down("w").pause(0.3).key_up("w").perform()
    poses.append(pose())
    browser.element("cameras").click()
    browser.wait("document.querySelectorAll('#frusta g:not([hidden])').length > 0")
    wheel = actions(browser.driver)
    for _ in range(3):  # from farther off more cameras are seen
        wheel.scroll_by_amount(0, 300)
    wheel.perform()
    poses.append(pose())
    time.sleep(0.5)
    x, y = browser.run(CLICKABLE)
    frustum = actions(browser.driver)
    frustum.move_to_element_with_offset(picture, x - 180, y - 120).click().perform()
    assert len(set(poses)) == 4 and pose() != poses[-1]
    browser.element("home").click()
    assert pose() == poses[0]
    folder = {"behavior": "allow", "downloadPath": str(tmp_path)}
    browser.driver.execute_cdp_cmd("Page.setDownloadBehavior", folder)
    browser.element("save").click()
    saved = tmp_path / "tiny_t1.000.png"
    until = time.monotonic() + PATIENCE
    while not saved.is_file():
        assert time.monotonic() < until
        time.sleep(0.1)
    assert iio.imread(saved).shape[:2] == (240, 360)
    assert browser.said() == []


def test_beside_the_rest_state_cameras_and_a_double_click_do_what_they_do_without(browser, file):
    actions = pytest.importorskip("selenium.webdriver.common.action_chains").ActionChains
    width, height = 360, 240
    browser.open(file.as_uri() + "#time=0", width, height)
    browser.wait("document.body.className === 'ready'")

    def target_of(x: int, y: int) -> np.ndarray:
        browser.element("home").click()
        picture = browser.element("picture")
        hand = actions(browser.driver)
        hand.move_to_element_with_offset(picture, x - width // 2, y - height // 2)
        hand.double_click().perform()
        browser.element("link").click()
        words = browser.run("return location.hash")
        pose, distance = (re.search(f"{word}=([^&]*)", words)[1] for word in ("pose", "distance"))
        poses = np.array(pose.split(","), float).reshape(3, 4)
        return poses[:, 3] - float(distance) * poses[:, 2]

    def corners() -> np.ndarray:
        browser.element("home").click()
        browser.wait("document.querySelectorAll('#frusta g:not([hidden])').length > 0")
        time.sleep(0.5)
        points = "[...document.querySelectorAll('#frusta g:not([hidden]) polygon')]"
        lists = browser.run(f"return {points}.map((lines) => lines.getAttribute('points'))")
        return np.array([[float(word) for word in re.split("[ ,]", line)] for line in lists])

    target = target_of(190, 120)
    browser.element("cameras").click()
    alone = corners().reshape(-1, 2)
    browser.element("rest").click()
    beside = corners().reshape(-1, 2)
    middle = np.array([width / 2, height / 2])
    assert beside == pytest.approx((alone - middle) / 2 + [3 * width / 4, height / 2], abs=0.02)
    wheel = actions(browser.driver)
    for _ in range(3):  # from farther off more cameras are seen
        wheel.scroll_by_amount(0, 300)
    wheel.perform()
    time.sleep(0.5)
    x, y = browser.run(CLICKABLE)
    assert x >= width / 2  # what would lie on the rest state is cut off
    browser.element("cameras").click()
    assert np.linalg.norm(target) > 0.05  # not the middle
    for x in (95, 275):
        assert target_of(x, 120) == pytest.approx(target, abs=0.05)
    assert browser.said() == []


def test_a_page_of_ones_own_shows_it_by_the_line_that_export_prints(browser, file):
    own = file.with_name("index.html")
    style = "<style>iframe {width: 160px; height: 100px}</style>"
    own.write_text(f"<!doctype html><title>mine</title>{style}<p>a page of my own</p>{FRAME}")
    camera = Cameras.looking_at(
        torch.tensor([[0.0, -4.0, 0.5]]), torch.zeros(1, 3), focal=180.0, width=160, height=100
    )
    browser.open(own.as_uri(), 500, 400)
    browser.driver.switch_to.frame(0)
    browser.wait("document.body.className === 'ready'")
    browser.run(f"location.hash = '{link(camera, 0.4)}'")
    browser.wait("document.getElementById('clock').textContent === '0.400'")
    framed = browser.canvas()
    browser.driver.switch_to.default_content()
    assert browser.run("return document.title") == "mine"
    browser.open(file.as_uri() + link(camera, 0.4), 160, 100)
    alone = browser.canvas()
    assert framed.shape == alone.shape == (100, 160, 3)
    assert framed.std() > 0.05 and psnr(framed, alone) > LEAST_PSNR


def test_a_frame_that_begins_collapsed_shows_the_scene_once_it_has_room(browser, file):
    own = file.with_name("index.html")
    own.write_text(f"<iframe src='{file.name}' style='width: 0; height: 0; border: 0'></iframe>")
    browser.open(own.as_uri(), 300, 200)
    browser.driver.switch_to.frame(0)
    browser.wait("document.getElementById('clock').textContent > '0.5'")  # time runs, frames load
    browser.driver.switch_to.default_content()
    browser.run("document.querySelector('iframe').style = 'width: 80px; height: 60px; border: 0'")
    browser.driver.switch_to.frame(0)
    browser.wait("document.documentElement.dataset.rows === '60'")
    browser.run("document.getElementById('play').click()")
    picture = browser.canvas()
    assert picture.shape == (60, 80, 3) and picture.std() > 0.05
    assert browser.said() == []
    browser.driver.switch_to.default_content()


@pytest.mark.parametrize("words", ["distance=Infinity&fov=40", "distance=3&fov=200"])
def test_a_link_to_no_camera_leaves_the_first_one(browser, file, words):
    browser.open(file.as_uri() + f"#pose=1,0,0,0,0,1,0,0,0,0,1,4&{words}&time=0.4")
    wrong = browser.canvas()
    browser.open(file.as_uri() + "#time=0.4")
    assert psnr(wrong, browser.canvas()) > 60


@pytest.mark.parametrize(
    ("clipboard", "said"),
    [
        ("{writeText: async () => {}}", "the link is copied, and in the address"),
        ("{writeText: async () => {throw new Error('denied')}}", "the link is in the address"),
        ("undefined", "the link is in the address"),  # of a page that came over http
    ],
)
def test_a_link_is_said_to_be_copied_where_it_is(browser, file, clipboard, said):
    browser.open(file.as_uri() + "#time=0.4", 360, 130)
    browser.canvas()
    browser.run(f"Object.defineProperty(navigator, 'clipboard', {{value: {clipboard}}})")
    browser.element("link").click()
    browser.wait(f"document.getElementById('status').textContent === '{said}'")
    assert "time=0.4" in browser.run("return location.hash") and browser.said() == []


def test_fingers_turn_and_pinch(browser, file):
    browser.open(file.as_uri() + "#time=0", 390, 500)
    browser.wait("document.body.className === 'ready'")

    def touch(kind: str, *points: tuple[int, int]) -> None:
        fingers = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]
        event = {"type": f"touch{kind}", "touchPoints": fingers}
        browser.driver.execute_cdp_cmd("Input.dispatchTouchEvent", event)

    def link_now() -> str:
        browser.element("link").click()
        return str(browser.run("return location.hash"))

    before = link_now()
    touch("Start", (100, 100))
    touch("Move", (160, 110))
    touch("End")
    turned = link_now()
    assert turned.partition("&")[0] != before.partition("&")[0]
    touch("Start", (100, 100), (200, 100))
    touch("Move", (100, 100), (300, 100))
    touch("End")
    distance = [float(re.search(r"distance=([^&]*)", text)[1]) for text in (turned, link_now())]
    assert distance[1] == pytest.approx(distance[0] / 2, rel=0.05)


def failing(file: Path, change: Callable[[str], str]) -> str:
    broken = file.with_name("broken.html")
    broken.write_text(change(file.read_text("utf-8")), encoding="utf-8")
    return broken.as_uri()


@pytest.mark.parametrize("share", [0.2, 0.9])
def test_a_truncated_file_says_so(browser, file, share):
    browser.open(failing(file, lambda text: text[: int(share * len(text))]))
    browser.wait("document.getElementById('message').offsetHeight > 0")
    assert "incomplete" in browser.message
    assert browser.run("return document.getElementById('picture')?.offsetHeight ?? 0") == 0


@pytest.mark.parametrize("part", ["features", "displacement-1"])
def test_damaged_data_are_named(browser, file, part):
    def damage(text: str) -> str:
        at = text.index(f'id="{part}">') + len(part) + 60
        return text[:at] + ("A" if text[at] != "A" else "B") * 8 + text[at + 8 :]

    browser.open(failing(file, damage))
    browser.wait("document.body.className === 'failed'")
    assert "damaged or incomplete" in browser.message and part in browser.message
    assert browser.run("return document.getElementById('picture').offsetHeight") == 0


def test_without_webgl_and_after_a_lost_context_there_is_a_line(browser, file):
    none = "HTMLCanvasElement.prototype.getContext = () => null;"
    browser.open(
        failing(file, lambda text: text.replace("<body>", f"<body><script>{none}</script>"))
    )
    browser.wait("document.body.className === 'failed'")
    assert "no WebGL 2" in browser.message
    browser.open(file.as_uri())
    browser.wait("document.body.className === 'ready'")
    browser.run(
        "document.getElementById('picture').getContext('webgl2')"
        ".getExtension('WEBGL_lose_context').loseContext()"
    )
    browser.wait("document.body.className === 'failed'")
    assert "lost context" in browser.message


# Without a browser


@pytest.mark.parametrize("name", ["{{data}}", "{{x}}", "</script><script>alert(1)", "a\x1b\u202eb"])
def test_a_scene_may_be_called_as_a_part_of_the_page(moving, tiny_scene, name):
    plain, text = (page(moving, Viewpoints.of(tiny_scene), n, "0123abcd") for n in ("plain", name))
    described = re.search(r'id="description">(.*)</script>', text)[1]
    assert json.loads(described)["name"] == name and text.count("</script>") == plain.count(
        "</script>"
    )
    title = re.search("<title>(.*)</title>", text)[1]
    assert html.unescape(title) == f"{shown(name)} · devrf"


def test_all_data_are_in_the_file_and_as_large_as_their_textures(moving, tiny_scene):
    text = page(moving, Viewpoints.of(tiny_scene), "tiny", "0123abcd")
    described = json.loads(re.search(r'id="description">(.*)</script>', text)[1])
    bytes_of = {"density": 2, "rough": 3, "features": 4, "weights": 16, "distances": 1, "moving": 1}
    bytes_of |= {"palette": 3, "displacement": 6, "residual": 6}
    found = re.findall(r'<script type="text/plain" id="([a-z]+)(-\w+)?">(.+)</script>', text)
    for kind, _, packed in found:
        data = gzip.decompress(base64.b64decode(packed))
        assert len(data) == math.prod(described["shapes"][kind]) * bytes_of[kind]
    (packed,) = (
        packed for kind, number, packed in found if (kind, number) == ("displacement", "-1")
    )
    numbers = np.frombuffer(gzip.decompress(base64.b64decode(packed)), np.float16).astype(float)
    step = described["uniforms"]["displacementStep"]
    true = moving.deformation.backward_slices[1].numpy().flatten()
    kept = numbers != 0
    assert kept.mean() > 0.5
    assert abs(step * numbers - true)[kept].max() <= step * (0.5 + 2**-11 * abs(numbers).max())
    names = [kind + number for kind, number, _ in found]
    changing = [f"{kind}-{k}" for k in range(3) for kind in ("displacement", "residual")]
    assert sorted(names) == sorted(
        [
            "density",
            "rough",
            "features",
            "weights",
            "moving",
            "palette",
            "distances-rest",
            "distances-0",
            "distances-1",
            *changing,
        ]
    )
    assert described["times"] == [0.0, 0.4, 1.0]
    assert not re.search(r"""(src|href)=["'](?!data:)|https?://""", text)  # nothing is fetched


def test_an_off_centre_principal_point_moves_the_middle(moving, tiny_scene):
    viewpoints = Viewpoints.of(tiny_scene)
    off = replace(
        viewpoints.static,
        focal=torch.tensor([[20.0, 40.0]]).expand(len(viewpoints.static), 2),
        center=torch.tensor([[8.0, 11.0]]).expand(len(viewpoints.static), 2),
    )
    *_, camera = described(moving, replace(viewpoints, static=off))
    # 24×18 pixels, whose middle (12, 9) is 4 pixels to the right of the point, and 2 above.
    assert camera["middle"] == pytest.approx([4 / 20, 2 / 40])


def test_a_scene_at_rest_has_no_motion(learned, tiny_scene):
    text = page(learned[0].scene_model, Viewpoints.of(tiny_scene), "tiny", "0123abcd")
    described = json.loads(re.search(r'id="description">(.*)</script>', text)[1])
    assert described["times"] == [0.0] and described["defines"]["MOVES"] == 0


def test_keys_of_controls_that_a_scene_has_not_do_nothing(browser, learned, tiny_scene, tmp_path):
    path = tmp_path / "rest.html"
    text = page(learned[0].scene_model, Viewpoints.of(tiny_scene), "tiny", "0123abcd")
    path.write_text(text, encoding="utf-8")
    browser.open(path.as_uri(), 120, 90)
    browser.wait("document.body.className === 'ready'")
    pressed = (
        "document.body.dispatchEvent(new KeyboardEvent('keydown', {bubbles: true, code: '%s'}))"
    )
    for code, name, whether in (("KeyC", "cameras", True), ("KeyR", "rest", False)):
        browser.run(pressed % code)
        assert browser.run(f"return document.getElementById('{name}').checked") is whether


def test_other_methods_are_refused_in_one_line(tiny_scene):
    model: Any = SimpleNamespace(name="tineuvox")
    with pytest.raises(DevrfError, match=r"^method=tineuvox: the page draws DeVRF's fields"):
        page(model, Viewpoints.of(tiny_scene), "tiny", "0123abcd")


def test_the_server_gives_page_and_pictures_to_its_own_page_alone(tiny_scene, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    (tmp_path / "export").mkdir()
    (tmp_path / "export" / "scene.html").write_text("<p>a page</p>")
    log = tmp_path / "run.log"
    log.write_text("a log")
    pictures = tmp_path / "export" / "pictures"
    (pictures / "static_0").mkdir(parents=True)
    (pictures / "static_0" / "0.jpg").symlink_to(log)
    (tmp_path / "export" / ".partial-pictures").mkdir()  # by a process that was killed
    write_thumbnails(pictures, tiny_scene, Viewpoints.of(tiny_scene))
    assert {*os.listdir(tmp_path / "export")} == {"scene.html", "pictures"}
    assert log.read_text() == "a log"
    served = PageServer(ViewerSettings(port=port), tmp_path / "export")

    def answer(path: str, **headers: str) -> tuple[int, bytes]:
        request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=20) as response:
                return response.status, response.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()

    try:
        assert answer("/") == (200, b"<p>a page</p>")
        views = tiny_scene.dynamic.train
        seen = ((views.view == views.view.unique()[1]) & (views.times == 0.5)).nonzero().item()
        for path, truth in (
            ("/pictures/static_2/0.jpg", thumbnail(tiny_scene, tiny_scene.static.train, 2)),
            ("/pictures/dynamic_1/1.jpg", thumbnail(tiny_scene, views, seen)),
        ):
            status, picture = answer(path)
            assert status == 200
            away = torch.from_numpy(iio.imread(picture)).float() - truth.float()
            assert float(away.abs().mean()) < 8
        for path in (
            *("/pictures/static_99/0.jpg", "/pictures/dynamic_0/9.jpg", "/pictures/"),
            *("/x", "/etc/passwd", "/../run.log", "/%2e%2e/run.log", "//run.log"),
        ):
            assert answer(path)[0] == 404
        status, text = answer("/", Host="elsewhere.example")
        assert status == 403 and b"this machine is not 'elsewhere.example'" in text
        assert answer("/", Host="[")[0] == 403
        # Another run's page was there before, at the same address.
        later = "Fri, 31 Dec 2100 00:00:00 GMT"
        assert answer("/", **{"If-Modified-Since": later}) == (200, b"<p>a page</p>")
        assert answer("/", Origin="http://elsewhere.example")[0] == 403
    finally:
        served.close()


@pytest.fixture
def port(tmp_path) -> Iterator[int]:
    """Where a server serves a page, a picture, and a folder with links and a pipe."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    pictures = tmp_path / "export" / "pictures"
    (pictures / "static_0").mkdir(parents=True)
    (tmp_path / "export" / "scene.html").write_text("<p>a page</p>")
    Image.new("RGB", (8, 6)).save(pictures / "static_0" / "0.jpg")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "7.jpg").write_text("a secret")
    (pictures / "static_0" / "7.jpg").symlink_to(tmp_path / "other" / "7.jpg")
    (pictures / "leak").symlink_to(tmp_path / "other")
    (pictures / "static_0" / "notes.txt").write_text("a secret")
    os.mkfifo(pictures / "static_0" / "8.jpg")
    served = PageServer(ViewerSettings(port=port), tmp_path / "export")
    yield port
    served.close()


def answered(port: int, request: str) -> bytes:
    """What a server answers."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall(request.encode("latin-1"))
        return b"".join(iter(lambda: client.recv(2**16), b""))


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_the_server_gives_page_and_pictures_alone(port, method):
    def status(path: str, **headers: str) -> bytes:
        lines = {"Host": f"127.0.0.1:{port}", **headers}
        text = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in lines.items())
        answer = answered(port, f"{method} {path} HTTP/1.0\r\n{text}\r\n")
        assert b"a secret" not in answer
        for header in (
            b"Cross-Origin-Resource-Policy: same-origin",
            b"X-Content-Type-Options: nosniff",
            b"frame-ancestors 'none'; form-action 'none'; base-uri 'none'",
        ):
            assert header in answer
        return answer[9:12]

    assert status("/") == b"302"
    assert status("/scene.html?pictures") == status("/pictures/static_0/0.jpg") == b"200"
    assert status("/scene.html", Sec_Fetch_Site="same-origin") == b"200"
    assert status("/scene.html", Host=f"localhost:{port}") == b"200"
    assert status("/scene.html", Host="[::1]") == b"200"
    for path in (
        *("/pictures/static_0/7.jpg", "/pictures/leak/7.jpg", "/pictures/static_0/8.jpg"),
        *("/pictures/static_0/notes.txt", "/pictures/static_0", "/pictures/", "/%00", "//[", "*"),
        *("http://[", f"/pictures/{'a' * 5000}/0.jpg", "/scene.html/", "/./scene.html"),
    ):
        assert status(path) == b"404", path
    for refused in (
        *({"Origin": origin} for origin in ("http://[", "null", "", "http://elsewhere.example")),
        *({"Host": host} for host in ("[", "", "\xff", "[evil.com]", "127.0.0.1@evil.com", "²")),
        {"Sec_Fetch_Site": "cross-site"},
    ):
        assert status("/scene.html", **refused) == b"403", refused


def test_clients_that_are_slow_or_go_away_hold_nothing_and_are_not_told(port, monkeypatch, capfd):
    monkeypatch.setattr("devrf.apps.viewer.page._Handler.timeout", 1.0)
    threads = []
    slow = [socket.create_connection(("127.0.0.1", port), timeout=20) for _ in range(150)]
    for client in slow:
        with suppress(OSError):  # ended: there are too many
            client.sendall(b"GET /sc")
        threads.append(threading.active_count())
    assert max(threads) < 80  # each may send megabytes
    began = time.monotonic()
    request = f"GET /scene.html HTTP/1.0\r\nHost: 127.0.0.1:{port}\r\n\r\n"
    assert b"<p>a page</p>" in answered(port, request)
    assert time.monotonic() - began < 10
    with suppress(ConnectionError):
        assert slow[-1].recv(1) == b""
    for client in slow:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset
        client.close()
    assert b"<p>a page</p>" in answered(port, request)
    assert capfd.readouterr().err == ""


def test_threads_that_answer_nobody_are_no_clients(port):
    ended = threading.Event()
    idle = [threading.Thread(target=ended.wait) for _ in range(80)]
    try:
        for thread in idle:
            thread.start()
        request = f"GET /scene.html HTTP/1.0\r\nHost: 127.0.0.1:{port}\r\n\r\n"
        assert b"<p>a page</p>" in answered(port, request)
    finally:
        ended.set()


def no_thread(self: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_clients_for_whom_no_thread_begins_have_no_place(port, monkeypatch):
    request = f"GET /scene.html HTTP/1.0\r\nHost: 127.0.0.1:{port}\r\n\r\n"
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_thread)
        for _ in range(66):
            assert answered(port, request) == b""
    assert b"<p>a page</p>" in answered(port, request)


def test_a_server_ends_at_once_while_clients_wait_to_be_answered(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    served = PageServer(ViewerSettings(port=port), tmp_path)
    clients = [socket.create_connection(("127.0.0.1", port), timeout=20) for _ in range(66)]
    time.sleep(0.5)  # 64 have a place
    began = time.monotonic()
    served.close()
    assert time.monotonic() - began < 3
    for client in clients:
        client.close()


def test_another_page_shows_neither_pictures_nor_the_page(browser, port, tmp_path):
    picture = f"http://127.0.0.1:{port}/pictures/static_0/0.jpg"
    tried = "window.ended = 0; for (const kind of ['onload', 'onerror'])"
    other = tmp_path / "other.html"
    other.write_text(
        f"<img src='{picture}'><iframe src='http://127.0.0.1:{port}/scene.html'></iframe>"
        f"<script>{tried} document.images[0][kind] = () => window.ended += 1</script>"
    )
    browser.open(f"http://127.0.0.1:{port}/")
    assert "a page" in browser.run("return document.body.innerText")
    browser.run(f"window.own = new Image(); own.src = '{picture}'")
    browser.wait("own.naturalWidth === 8")
    browser.open(other.as_uri())
    browser.wait("window.ended === 1")
    assert browser.run("return document.images[0].naturalWidth") == 0
    browser.driver.switch_to.frame(0)
    assert "a page" not in browser.run("return document.body.innerText")
    browser.driver.switch_to.default_content()
