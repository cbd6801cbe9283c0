"""Pictures beside training: to those who watch, as seldom as their share of the time asks."""

from __future__ import annotations

import re
import time

import pytest

from devrf.apps.keyframes import Keyframe, keyframes_of
from devrf.apps.viewer.drawing import Drawing

pytest.importorskip("viser", reason="the viewer's extra is not installed")


class Page:
    """Stands for a session: draws one small picture in each step."""

    def __init__(self, keyframe: Keyframe) -> None:
        self.watched, self.keyframe, self.scheduler, self.controls = True, keyframe, self, self
        self.pictures, self.told, self.followed = list[float](), list[str](), set[float | None]()
        self.tell, self.follow = self.told.append, self.followed.add

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
    from devrf.callbacks import live_view

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
