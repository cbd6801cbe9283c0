"""Pictures beside training: to those who watch, as seldom as their share of the time asks."""

from __future__ import annotations

import math
import re
import socket
import time
from contextlib import ExitStack, nullcontext

import pytest
import torch

from devrf.apps.keyframes import Keyframe, keyframes_of
from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.drawing import Drawing
from devrf.checkpoints.checkpoint import Viewpoints

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed")


class Page:
    """Stands for a session: draws one small picture in each step."""

    def __init__(self, keyframe: Keyframe) -> None:
        self.watched, self.keyframe, self.scheduler, self.controls = True, keyframe, self, self
        self.pictures, self.told, self.followed = list[float](), list[str](), set[float | None]()
        self.tell, self.follow = self.told.append, self.followed.add
        self.surviving = nullcontext

    def present(self, drawing: Drawing) -> None:
        self.drawing = drawing

    def refresh(self) -> None:
        pass

    def step(self, timeout: float) -> bool:
        from devrf.apps.viewer.drawing import Shot

        *_, picture = self.drawing.draw(Shot(self.keyframe, 4 / 3), 12)
        self.pictures.append(picture.pixels.float().std().item())
        time.sleep(0.02)
        return True


@pytest.fixture
def fitted(fit, canonical, tiny_scene, monkeypatch):
    """``fitted(share)``: learns the tiny scene at rest with a page beside; callback, page, s."""
    from devrf.apps.viewer import live_view

    def learn(share: float):
        monkeypatch.setattr(live_view, "PAUSE", 0.0)
        page = Page(*keyframes_of(tiny_scene.dynamic.test.cameras[[0]], [0.0], 0.0))
        live, began = live_view.LiveView(page, share), time.perf_counter()
        fit(canonical(iterations=20, upsample_at=()), live)
        return live, page, time.perf_counter() - began

    return learn


def test_the_scene_is_shown_as_it_is_learned(fitted):
    live, page, _ = fitted(share=1.0)
    assert len(page.pictures) > 3 and live.seconds > 0.02 * len(page.pictures)
    assert page.pictures[0] != page.pictures[-1]
    assert page.told[0] == "**canonical** begins"
    assert re.match(r"\*\*canonical\*\*: static \d+/20  \d+\.\d dB  .* left$", page.told[2])
    assert "**canonical** has ended after 20 of 20 iterations." in page.told[-1]
    assert page.followed == {None}


def test_pictures_take_their_share_alone(fitted):
    live, page, seconds = fitted(share=0.01)
    # One is due at once; the next when a hundred times its time has gone.
    longest = live.seconds / len(page.pictures)
    assert live.seconds <= 0.01 * seconds + 2 * longest


@pytest.fixture
def session(tiny_scene, tmp_path, monkeypatch):
    """A real page, which nothing but its share keeps from rendering."""
    from devrf.apps.viewer import live_view
    from devrf.apps.viewer.session import Session

    monkeypatch.setattr(live_view, "PAUSE", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    settings = ViewerSettings(port=port, height=16)
    served = Session(settings, Viewpoints.of(tiny_scene), tiny_scene, tmp_path)
    yield served
    served.close()


@pytest.fixture
def tab(session):
    """``tab(**said)``: opens the page as a browser does, whose camera is as it ``said``."""
    import msgspec
    from websockets.sync.client import connect

    usual = {"wxyz": (1.0, 0, 0, 0), "position": (0, 0, 3.0), "look_at": (0, 0, 0), "fov": 1.0}
    usual |= {"up_direction": (0, 0, 1.0), "near": 0.01, "far": 1000.0}
    usual |= {"type": "ViewerCameraMessage", "image_width": 24, "image_height": 16}
    with ExitStack() as tabs:

        def opened(**said):
            before = len(session.server.get_clients())
            address = session.settings.address.replace("http", "ws")
            version = f"viser-v{viser.__version__}"
            unread = {"max_size": None, "max_queue": None, "ping_interval": None}
            connection = connect(address, subprotocols=[version], **unread)
            tabs.enter_context(connection).send(msgspec.msgpack.encode(usual | said))
            until = time.monotonic() + 20
            while len(session.server.get_clients()) == before:
                assert time.monotonic() < until
                time.sleep(0.01)

        yield opened


HOSTILE = (
    {"image_width": 0},
    {"image_height": 0},
    {"image_width": -24},
    {"image_width": 10**6},
    {"image_height": 10**6},
    {"fov": 0.0},
    {"fov": math.nan},
    {"fov": 1e300},
    {"position": (math.nan, 0.0, 0.0)},
    {"position": (0.0, math.inf, 0.0)},
    {"position": (1e300, 0.0, 0.0)},
    {"wxyz": (0.0, 0.0, 0.0, 0.0)},
    {"wxyz": (math.nan, 0.0, 0.0, 0.0)},
    {"wxyz": (1.0, 0.0)},
)


@pytest.mark.filterwarnings("ignore:.*does not match annotation")
def test_no_tab_of_a_browser_ends_learning(fit, canonical, session, tab, caplog):
    from devrf.apps.viewer.live_view import LiveView

    for said in (*HOSTILE, {}):
        tab(**said)
    stage = fit(canonical(iterations=40, upsample_at=()), LiveView(session, 1.0))
    assert stage.position.iteration == stage.schedule.total and session.frames > len(HOSTILE)
    assert not caplog.records
    assert len(session.scheduler._requests) == 5  # of those that have an area and a pose


@pytest.mark.parametrize("error", [ZeroDivisionError("float"), torch.OutOfMemoryError("CUDA")])
def test_no_error_of_the_viewer_ends_learning(
    fit, canonical, session, tab, caplog, monkeypatch, error
):
    from devrf.apps.viewer import live_view

    tab()
    render = Drawing.draw

    def fails_now_and_then(drawing, shot, height):
        if shot.keyframe.time < 0 or session.frames % 2:
            session.frames += 1
            raise error
        return render(drawing, shot, height)

    monkeypatch.setattr(Drawing, "draw", fails_now_and_then)
    stage = fit(canonical(iterations=20, upsample_at=()), live_view.LiveView(session, 1.0))
    assert stage.position.iteration == stage.schedule.total and session.frames > 4
    kind = type(error).__name__
    assert caplog.messages == [f"viewer: {kind}: {error}; it goes on, and says this once"]
