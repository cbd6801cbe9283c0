"""The viewer: poses, frames of each channel, which is rendered next, time, keyframes, settings."""

from __future__ import annotations

import math
import shlex
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from devrf.apps.keyframes import Keyframe, keyframes_of
from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.cameras import dynamic_frusta, from_browser, in_browser, static_frusta
from devrf.apps.viewer.drawing import Drawing, Frame, RenderScheduler, Shot
from devrf.cli.restore_config import parsed
from devrf.errors import DevrfError
from devrf.pictures.images import to_bytes
from devrf.rendering.renderer import Renderer


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def page_camera(**said):
    """A page's camera as viser holds it, with some of it as the page ``said``."""
    usual = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 3), "fov": 1.0}
    return SimpleNamespace(**(usual | {"image_width": 300, "image_height": 200} | said))


def test_a_camera_of_the_browser_by_hand_and_back():
    # OpenCV's camera that looks along z with y down is OpenGL's turned about x by half a turn.
    camera = page_camera(wxyz=(1.0, 0, 0, 0), position=(1.0, 2, 3), fov=math.pi / 2)
    keyframe, aspect = from_browser(camera, 0.3, 2.0)
    assert aspect == 1.5
    assert keyframe.camera_to_world.tolist() == [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3]]
    assert (keyframe.fov, keyframe.time, keyframe.seconds) == (pytest.approx(90.0), 0.3, 2.0)
    wxyz, position, fov = in_browser(keyframe)
    assert wxyz.tolist() == [1, 0, 0, 0] and position.tolist() == [1, 2, 3]
    assert fov == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(
    "said",
    [
        *({"image_width": width} for width in (0, -300, math.nan, math.inf, "wide", None)),
        *({"image_height": height} for height in (0, -200, math.nan, math.inf)),
        *({"fov": angle} for angle in (math.nan, math.inf, "wide")),
        *({"position": place} for place in ((0, math.nan, 0), (math.inf, 0, 0), (0, 1e300, 0))),
        *({"wxyz": turn} for turn in ((math.nan, 0, 0, 0), (1, 0, math.inf, 0))),
        *({"position": place} for place in ((0, 0), (), ("a", "b", "c"), None)),
    ],
)
def test_a_page_that_cannot_be_rendered_is_refused(said):
    with pytest.raises(DevrfError, match="^the page has no area, or its camera no pose"):
        from_browser(page_camera(**said), 0.0)


@pytest.mark.parametrize(
    ("said", "fov", "aspect"),
    [
        ({"fov": 0.0}, 1.0, 1.5),
        ({"fov": -1.0}, 1.0, 1.5),
        ({"fov": math.pi}, 179.0, 1.5),
        ({"fov": 1e6}, 179.0, 1.5),
        ({"image_width": 10**6}, math.degrees(1.0), 10.0),
        ({"image_height": 10**6}, math.degrees(1.0), 0.1),
        ({"wxyz": (0, 0, 0, 0)}, math.degrees(1.0), 1.5),
        ({"position": (1e9, 0, 0)}, math.degrees(1.0), 1.5),
    ],
)
def test_a_page_that_says_too_much_is_brought_within_limits(drawing, said, fov, aspect):
    keyframe, seen_aspect = from_browser(page_camera(**said), 0.7)
    assert keyframe.fov == pytest.approx(fov) and seen_aspect == pytest.approx(aspect)
    for beside in (False, True):
        frame = drawn(drawing, Shot(keyframe, seen_aspect, beside_rest=beside), 4)
        assert frame.pixels.shape[0] == 4 and frame.pixels.shape[1] <= 40


# Frames: as the renderer's images, in blocks.


def drawn(drawing, shot, height=18):
    *blocks, frame = drawing.draw(shot, height)
    assert blocks and not any(blocks)
    return frame


@pytest.fixture
def drawing(moving):
    return Drawing(Renderer(moving, times=6), 1.0)


@pytest.fixture
def shot(tiny_scene):
    (keyframe,) = keyframes_of(tiny_scene.dynamic.test.cameras[[0]], [0.7], 0.0)
    return Shot(keyframe, 24 / 18)


@pytest.fixture
def seen(moving, tiny_scene):
    """What the renderer shows of the shot."""
    return Renderer(moving).view(tiny_scene.dynamic.test.cameras, 0, 0.7, 1.0)


def test_the_frame_is_the_renderers_in_blocks_of_any_size(drawing, shot, seen, monkeypatch):
    frame = drawn(drawing, shot)
    assert frame.pixels.shape == (18, 24, 3) and frame.depth is None
    difference = frame.pixels.int() - to_bytes(seen.color).view(18, 24, 3).int()
    assert int(difference.abs().max()) <= 1 and len(torch.unique(frame.pixels)) > 20
    monkeypatch.setattr("devrf.apps.viewer.drawing.MIN_RAYS", 100)
    monkeypatch.setattr("devrf.apps.viewer.drawing.BLOCK_SECONDS", 0)
    *blocks, small = drawing.draw(shot, 18)
    assert len(blocks) == 4  # of 18 rows, five at a time
    assert int((small.pixels.int() - frame.pixels.int()).abs().max()) <= 1


def test_what_a_scene_offers(drawing, learned):
    assert drawing.channels == ("color", "depth", "opacity", "motion")
    assert drawing.has_rest and not drawing.at_rest
    at_rest = Drawing(Renderer(learned[0].scene_model), 1.0)
    assert at_rest.channels == ("color", "depth", "opacity")
    assert at_rest.at_rest and not at_rest.has_rest


def test_each_channel_has_a_frame_of_its_own(drawing, shot):
    color = drawn(drawing, shot).pixels
    for channel in ("depth", "opacity", "motion"):
        other = drawn(drawing, replace(shot, channel=channel)).pixels
        assert other.shape == color.shape and not torch.equal(other, color)
    opacity = drawn(drawing, replace(shot, channel="opacity")).pixels
    assert int(opacity[0, 0, 0]) == 0 and int(opacity.max()) > 200


def test_motion_is_that_of_the_picture_from_afar(drawing, shot):
    def saturated(away):
        """The share of colourful pixels from ``away`` times as far, as large in the picture."""
        pose, fov = shot.keyframe.camera_to_world.clone(), math.radians(shot.keyframe.fov)
        pose[:, 3] *= away  # it looks at the origin
        fov = math.degrees(2 * math.atan(math.tan(fov / 2) / away))
        keyframe = replace(shot.keyframe, camera_to_world=pose, fov=fov)
        frame = drawn(drawing, replace(shot, channel="motion", keyframe=keyframe), 60)
        return float((frame.pixels.amin(dim=2) < 200).float().mean())

    assert saturated(1) > 0.01
    for away in (1.5, 3, 10):  # rays begin at the box
        assert saturated(away) == pytest.approx(saturated(1), rel=0.3)


def test_a_part_is_drawn_by_its_own_renderer(drawing, learned, shot):
    whole = drawn(drawing, shot).pixels
    at_rest = Renderer(learned[0].scene_model)
    parts = Drawing(drawing.renderer, 1.0, {"still": at_rest})
    assert torch.equal(drawn(parts, shot).pixels, whole)
    still = drawn(parts, replace(shot, part="still")).pixels
    assert torch.equal(still, drawn(Drawing(at_rest, 1.0), shot).pixels)
    assert not torch.equal(still, whole)


def test_the_rest_state_is_on_the_left_and_nothing_is_cut_off(drawing, shot):
    beside = drawn(drawing, replace(shot, beside_rest=True), 20).pixels
    rest = replace(shot, keyframe=replace(shot.keyframe, time=0.0))
    assert torch.equal(beside[5:15, :13], drawn(drawing, rest, 10).pixels)
    assert torch.equal(beside[5:15, 13:], drawn(drawing, shot, 10).pixels)


def test_depth_is_along_the_axis_and_far_where_nothing_is(drawing, shot, seen):
    depth = drawn(drawing, replace(shot, with_depth=True)).depth
    solid = (seen.opacity > 0.5).view(18, 24)
    assert float(depth[~solid].min()) == 1000
    assert bool((depth[solid] < seen.depth.view(18, 24)[solid] + 1e-4).all())
    assert bool((depth[solid] > 0.9 * seen.depth.view(18, 24)[solid]).all())


def test_captured_cameras_have_their_images(tiny_scene):
    views = tiny_scene.dynamic.train
    early, late = dynamic_frusta(tiny_scene, 0.0), dynamic_frusta(tiny_scene, 1.0)
    assert [f.name for f in early] == [f.name for f in late] == ["moving/0", "moving/1"]
    pixels = views.pixels[int((views.times == 1).nonzero()[0, 0])].float()
    expected = 255 + pixels[..., 3:] / 255 * (pixels[..., :3] - 255)
    assert float((late[0].image.float() - expected).abs().max()) <= 1
    cameras = tiny_scene.static.train.cameras
    read, unread = static_frusta(cameras, tiny_scene), static_frusta(cameras, None)
    assert [f.name for f in read] == [f.name for f in unread] and len(read) == 8
    assert all(f.image is not None for f in read) and all(f.image is None for f in unread)


# The scheduler: a coarse frame comes first; a finer one ends when its browser moves.

FIRST, SECOND = (Shot(Keyframe(torch.eye(3, 4), 60.0, time, 0.0), 1.0) for time in (0.1, 0.2))


class Screen:
    """A scheduler whose frames have three blocks; ``between`` is called after each."""

    def __init__(self, coarse=20):
        self.coarse, self.shown = coarse, list[tuple[object, float, int]]()
        self.between: Callable[[int], None] = lambda rows: None
        self.stop = threading.Event()
        self.scheduler = RenderScheduler(self, self.show, ViewerSettings(height=100), self.stop)

    def height_within(self, seconds, aspect, height):
        return min(self.coarse, height)

    def draw(self, shot, height):
        for _ in range(3):
            self.between(height)
            yield None
        yield Frame(torch.full((height, 1, 3), shot.keyframe.time), None, 0.1)

    def show(self, key, frame):
        self.shown.append((key, round(float(frame.pixels[0, 0, 0]), 3), len(frame.pixels)))

    def render(self):
        for _ in range(20):
            self.scheduler.render_next(0)


def test_coarse_first_then_finer_up_to_the_full_height():
    screen = Screen()
    screen.scheduler.ask("a", FIRST)
    screen.render()
    assert screen.shown == [("a", 0.1, 20), ("a", 0.1, 60), ("a", 0.1, 100)]
    fast = Screen(coarse=90)
    threading.Timer(0.02, fast.scheduler.ask, ("a", FIRST)).start()
    assert fast.scheduler.render_next(20) and fast.shown == [("a", 0.1, 100)]


def test_a_move_ends_the_finer_frame_but_not_a_coarse_one():
    screen = Screen()
    # A camera that moves on and on would show nothing.
    screen.between = lambda rows: screen.scheduler.ask("a", SECOND)
    screen.scheduler.ask("a", FIRST)
    assert screen.scheduler.render_next(0) and screen.shown == [("a", 0.1, 20)]
    screen.between = lambda rows: None
    screen.scheduler.render_next(0)
    screen.between = lambda rows: rows == 60 and screen.scheduler.ask("a", FIRST)
    assert not screen.scheduler.render_next(0)
    screen.between = lambda rows: None
    screen.render()
    shown = [(time, rows) for _, time, rows in screen.shown[1:]]
    assert shown == [(0.2, 20), (0.1, 20), (0.1, 60), (0.1, 100)]


def test_another_browsers_first_frame_comes_before_the_finer_of_one():
    screen = Screen()
    screen.between = lambda rows: rows == 60 and screen.scheduler.ask("b", SECOND)
    screen.scheduler.ask("a", FIRST)
    screen.scheduler.render_next(0)
    assert not screen.scheduler.render_next(0)  # given up
    screen.between = lambda rows: None
    screen.render()
    assert [(key, rows) for key, _, rows in screen.shown][:3] == [("a", 20), ("b", 20), ("a", 60)]
    assert {key for key, _, rows in screen.shown if rows == 100} == {"a", "b"}


def test_browsers_are_served_in_turn_while_time_runs():
    screen = Screen()
    for _ in range(6):
        for key in "abc":  # time runs for all
            screen.scheduler.ask(key, FIRST)
        assert screen.scheduler.render_next(0)
    assert [key for key, _, _ in screen.shown] == [*"abcabc"]


def test_a_frame_that_fails_is_not_tried_again_and_costs_the_others_nothing():
    screen = Screen()
    draw = screen.draw

    def failing(shot, height):
        if shot is FIRST:
            raise ValueError(height)
        return draw(shot, height)

    screen.draw = failing
    screen.scheduler.ask("a", FIRST)
    screen.scheduler.ask("b", SECOND)
    with pytest.raises(ValueError, match="^20$"):
        screen.scheduler.render_next(0)
    screen.render()
    assert [rows for _, _, rows in screen.shown] == [20, 60, 100]
    screen.scheduler.ask("a", SECOND)  # it has moved on
    assert screen.scheduler.render_next(0) and screen.shown[-1][0] == "a"


def test_nothing_is_shown_to_who_has_left_or_once_it_is_stopped():
    screen = Screen()
    screen.between = lambda rows: screen.scheduler.drop("a")
    screen.scheduler.ask("a", FIRST)
    assert screen.scheduler.watched
    screen.render()
    assert not screen.shown and not screen.scheduler.watched
    screen.between = lambda rows: screen.stop.set()
    screen.scheduler.ask("a", FIRST)
    assert not screen.scheduler.render_next(0) and not screen.shown


# The page's controls.


def test_time_runs_at_its_speed_and_loops_or_stops():
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    from devrf.apps.viewer.controls import Playback

    assert Playback(time=0.3).advanced(10) == Playback(time=0.3)
    for speed, time in ((1, 0.4), (0.5, 0.3), (4, 1.0)):
        later = Playback(time=0.2, playing=True, speed=speed).advanced(1)
        assert later.time == pytest.approx(time) and later.playing
    assert Playback(time=0.9, playing=True).advanced(1).time == pytest.approx(0.1)
    ended = Playback(time=0.9, playing=True, loop=False).advanced(1)
    assert (ended.time, ended.playing) == (1.0, False)
    assert ended.toggled() == Playback(time=0.0, playing=True, loop=False)


def test_keyframes_are_collected_saved_loaded_and_flown_through(
    learned, moving, tiny_scene, tmp_path
):
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    from devrf.apps.viewer.controls import set_value
    from devrf.apps.viewer.paths import known_paths
    from devrf.apps.viewer.session import Session
    from devrf.checkpoints.checkpoint import Viewpoints

    settings = ViewerSettings(port=free_port(), height=48)
    run = tmp_path / "it's, a (1)"
    session = Session(settings, Viewpoints.of(tiny_scene), tiny_scene, run, "/a,b.ckpt")
    try:
        session.present(Drawing(Renderer(learned[0].scene_model), 1.0))
        controls = session.controls
        assert "bullet time" not in session.paths._preset.options and not controls._timing.visible
        session.present(Drawing(Renderer(moving, times=6), 1.0))
        assert "bullet time" in session.paths._preset.options and controls._timing.visible
        controls.follow(0.25)
        controls._time_set(SimpleNamespace(client=1))
        controls.follow(0.75)
        assert controls.playback.time == 0.25  # once a time is chosen on the page, it stays
        controls._crop_set(SimpleNamespace(client_id=3))
        set_value(controls._crop, True)
        controls.left(2)
        assert controls._crop.value  # another tab's
        controls.left(3)
        assert not controls._crop.value
        panel, told = session.paths, list[str]()
        client = SimpleNamespace(
            camera=page_camera(), add_notification=lambda title, text, **_: told.append(text)
        )
        event = SimpleNamespace(client=client)
        panel._answer(panel._save)(event)
        assert "a path needs two keyframes" in told[0] and not panel.drawn
        for time in (0.0, 0.5, 1.0):
            session.controls.set_time(time)
            panel._answer(panel._add)(event)
        assert [(k.time, k.seconds) for k in panel.keyframes] == [(0, 0), (0.5, 2), (1, 4)]
        assert panel.drawn
        panel._answer(panel._save)(event)
        file = run / "paths" / "path.json"
        *program, stage, folder, given, path = shlex.split(panel._command.value)
        assert program == ["python", "-m", "devrf"] and panel._command.visible
        read = [override.value() for override in parsed([stage, folder, given, path])]
        assert read == ["render", str(run), "/a,b.ckpt", str(file)]
        content = file.read_bytes()
        panel._take(())
        panel._upload = SimpleNamespace(value=SimpleNamespace(content=content, name="path.json"))
        panel._answer(panel._load)(event)
        assert [k.seconds for k in panel.keyframes] == [0, 2, 4]
        for preset in known_paths(tiny_scene.static.train.cameras, lambda: moving).values():
            panel._take(preset(0.5))
            assert panel.path().duration > 7
        session.controls.dynamic.value = session.controls.static.value = True
        session._fly(panel.path())
        session.step(0.0)
        assert len(session._frusta._handles) == 10
    finally:
        session.close()


def test_controls_say_what_they_offer_whatever_a_page_sends(learned, tiny_scene, tmp_path):
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    from devrf.apps.viewer.controls import set_value
    from devrf.apps.viewer.session import Session
    from devrf.checkpoints.checkpoint import Viewpoints

    settings = ViewerSettings(port=free_port(), height=16)
    session = Session(settings, Viewpoints.of(tiny_scene), tiny_scene, tmp_path)
    try:
        at_rest = Drawing(Renderer(learned[0].scene_model), 1.0)
        session.present(at_rest)
        controls, panel = session.controls, session.paths
        event = SimpleNamespace(client=SimpleNamespace(camera=page_camera()))
        for sent, time in ((math.nan, 0.0), (-5.0, 0.0), (math.inf, 1.0), (0.25, 0.25)):
            set_value(controls._time, sent)
            controls._time_set(event)
            assert controls.playback.time == time
        for sent, speed in (("nan", 0.1), ("1e300", 0.1), ("words", 0.1), ("2", 2.0)):
            set_value(controls._speed, sent)
            controls._pace_set(event)
            assert controls.playback.speed == speed
        box = learned[0].scene_model.box
        set_value(controls._channel, "motion")  # a scene at rest has none
        set_value(controls._part, "moving")
        set_value(controls._crop, True)
        set_value(controls._sides[0], (900, -900))
        shot = controls.shot(page_camera(), box, with_depth=False)
        assert (shot.channel, shot.part) == ("color", "all")
        assert shot.crop.low == pytest.approx(box.low) and shot.crop.high == pytest.approx(box.high)
        drawn(at_rest, shot, 16)
        for sent, seconds in ((math.nan, 0.05), (1e300, 600), (2.0, 2.0)):
            panel._take(())
            set_value(panel._gap, sent)
            for _ in range(2):
                panel._answer(panel._add)(event)
            assert panel.keyframes[1].seconds == seconds
    finally:
        session.close()


def test_other_pages_and_probes_of_the_port_get_nothing(caplog):
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    from devrf.apps.viewer.server import open_server, quiet

    port = free_port()

    def answer(request):
        with socket.create_connection(("127.0.0.1", port), timeout=20) as probe:
            probe.sendall(request.replace("%", str(port)).encode())
            return probe.recv(12) if request.endswith("\r\n\r\n") else None

    upgrade = (
        "GET / HTTP/1.1\r\nHost: {}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {22 * 'A'}==\r\nOrigin: {{}}\r\n\r\n"
    )
    with quiet():
        server = open_server(ViewerSettings(port=port))
        for half in ("", "GET / HT", "\0\1"):
            answer(half)
        own = ("127.0.0.1:%", "localhost:9000", socket.gethostname())  # one through a tunnel
        assert {answer(upgrade.format(host, f"http://{host}")) for host in own} == {b"HTTP/1.1 101"}
        others = ("http://elsewhere.org", "http://127.0.0.1:3000", "null")
        refused = [
            *(("127.0.0.1:%", page) for page in others),
            ("bound.org:%", "http://bound.org:%"),
        ]
        assert {answer(upgrade.format(*names)) for names in refused} == {b"HTTP/1.1 403"}
        assert answer("GET / HTTP/1.1\r\nHost: 127.0.0.1:%\r\n\r\n") == b"HTTP/1.1 200"
        server.stop()
    assert not caplog.records


@pytest.mark.parametrize(
    ("keys", "expected"), [({"port": 70000}, "viewer.port: "), ({"share": 2}, "viewer.share: ")]
)
def test_settings_that_cannot_be(keys, expected):
    with pytest.raises(DevrfError, match=expected):
        ViewerSettings(**keys)


def test_an_address_that_cannot_be_listened_on():
    assert ViewerSettings().address == "http://127.0.0.1:8080"  # this machine alone
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(DevrfError, match=rf"^viewer\.port: .*{port}"):
            ViewerSettings(port=port).check_free()
    ViewerSettings(port=port).check_free()
    with pytest.raises(DevrfError, match=r"^viewer\.host: "):
        ViewerSettings(host="192.0.2.1").check_free()
