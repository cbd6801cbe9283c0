"""Pictures beside training: to those who watch, as seldom as their share of the time asks."""

from __future__ import annotations

import time

import pytest

from devrf.apps.viewer.cameras import Pose
from devrf.apps.viewer.drawing import Drawing
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage

pytest.importorskip("viser", reason="the viewer's extra is not installed")


class Page:
    """Stands for a session: draws one small picture in each step."""

    def __init__(self, pose: Pose, watched: bool) -> None:
        self.watched, self.pose, self.scheduler = watched, pose, self
        self.pictures = list[float]()

    def present(self, drawing: Drawing) -> None:
        self.drawing = drawing

    def again(self) -> None:
        pass

    def step(self, timeout: float) -> bool:
        from devrf.apps.viewer.drawing import Shot

        *_, picture = self.drawing.draw(Shot(self.pose, 0.0), 12)
        self.pictures.append(picture.pixels.float().std().item())
        time.sleep(0.02)
        return True


@pytest.fixture
def fitted(trainer, datamodule, tiny_scene, monkeypatch):
    """Learns the tiny scene at rest with a page beside; returns callback and page."""
    from devrf.callbacks import live_view

    def fit(watched: bool, share: float):
        monkeypatch.setattr(live_view, "PAUSE", 0.0)
        page = Page(Pose.of_cameras(tiny_scene.dynamic.test.cameras, 0), watched)
        live = live_view.LiveView(page, share)
        schedule = CanonicalSchedule(
            search_iterations=0,
            search_side=16,
            visual_hull_init=True,
            iterations=60,
            side=16,
            upsample_at=(),
            rays=64,
        )
        stage = CanonicalStage(schedule, iterations_per_step=2)
        began = time.perf_counter()
        trainer(live, max_epochs=1).fit(stage, datamodule=datamodule)
        return live, page, time.perf_counter() - began

    return fit


def test_the_scene_is_shown_as_it_is_learned(fitted):
    live, page, _ = fitted(watched=True, share=1.0)
    assert len(page.pictures) > 3 and live.seconds > 0.02 * len(page.pictures)
    assert page.pictures[0] != page.pictures[-1]


def test_pictures_take_their_share_alone(fitted):
    live, page, seconds = fitted(watched=True, share=0.01)
    # One is due at once; the next when a hundred times its time has gone.
    longest = live.seconds / len(page.pictures)
    assert live.seconds <= 0.01 * seconds + 2 * longest
