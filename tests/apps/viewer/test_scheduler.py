"""A coarse picture comes first; a finer one ends when its viewer moves."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest
import torch

from devrf.apps.viewer.cameras import Pose
from devrf.apps.viewer.drawing import Picture, RenderScheduler, Shot

POSE = Pose((1.0, 0, 0, 0), (0.0, 0, 0), 1.0, 1.0)
FIRST, SECOND = Shot(POSE, 0.1), Shot(POSE, 0.2)


class Drawing:
    """Three blocks a picture; ``between`` is called after each."""

    def __init__(self, coarse: int = 20) -> None:
        self.coarse, self.begun = coarse, list[tuple[float, int]]()
        self.between: Callable[[int], None] = lambda rows: None

    def height_within(self, seconds: float, aspect: float, height: int) -> int:
        return min(self.coarse, height)

    def draw(self, shot: Shot, height: int) -> Iterator[Picture | None]:
        self.begun.append((shot.time, height))
        for _ in range(3):
            self.between(height)
            yield None
        yield Picture(torch.zeros(height, 1, 3), None, 0.1)


class Screen:
    def __init__(self, drawing: Drawing, **options: object) -> None:
        self.shown = list[tuple[object, float, int]]()
        self.scheduler = RenderScheduler(
            drawing, self.show, height=100, move_seconds=0.2, **options
        )

    def show(self, key: object, shot: Shot, picture: Picture) -> None:
        self.shown.append((key, shot.time, len(picture.pixels)))

    def render(self) -> None:
        for _ in range(20):
            self.scheduler.render_next(0)


@pytest.fixture
def drawing() -> Drawing:
    return Drawing()


def test_coarse_first_then_finer_up_to_the_full_height(drawing):
    screen = Screen(drawing)
    screen.scheduler.ask("a", FIRST)
    screen.render()
    assert screen.shown == [("a", 0.1, 20), ("a", 0.1, 60), ("a", 0.1, 100)]
    assert not screen.scheduler.render_next(0)


def test_a_fast_scene_has_its_full_picture_at_once():
    screen = Screen(Drawing(coarse=90))
    screen.scheduler.ask("a", FIRST)
    screen.render()
    assert screen.shown == [("a", 0.1, 100)]


def test_a_move_ends_the_finer_picture(drawing):
    screen = Screen(drawing)

    def move(rows: int) -> None:
        if rows == 60 and len(screen.shown) == 1:
            screen.scheduler.ask("a", SECOND)

    drawing.between = move
    screen.scheduler.ask("a", FIRST)
    screen.render()
    assert [(time, rows) for _, time, rows in screen.shown] == [
        (0.1, 20),
        (0.2, 20),
        (0.2, 60),
        (0.2, 100),
    ]
    assert (0.1, 60) in drawing.begun


def test_a_move_does_not_end_a_coarse_picture(drawing):
    # A camera that moves on and on would show nothing.
    screen = Screen(drawing)
    drawing.between = lambda rows: screen.scheduler.ask("a", SECOND)
    screen.scheduler.ask("a", FIRST)
    assert screen.scheduler.render_next(0)
    assert screen.shown == [("a", 0.1, 20)]
    drawing.between = lambda rows: None
    screen.render()
    assert screen.shown[-1] == ("a", 0.2, 100)


def test_another_viewers_first_picture_comes_before_the_finer_of_one(drawing):
    screen = Screen(drawing)
    drawing.between = lambda rows: rows == 60 and screen.scheduler.ask("b", SECOND)
    screen.scheduler.ask("a", FIRST)
    screen.scheduler.render_next(0)
    assert not screen.scheduler.render_next(0)  # given up
    drawing.between = lambda rows: None
    screen.render()
    assert [(key, rows) for key, _, rows in screen.shown][:3] == [("a", 20), ("b", 20), ("a", 60)]
    assert {key for key, _, rows in screen.shown if rows == 100} == {"a", "b"}


def test_who_has_left_is_shown_nothing(drawing):
    screen = Screen(drawing)
    drawing.between = lambda rows: screen.scheduler.drop("a")
    screen.scheduler.ask("a", FIRST)
    assert screen.scheduler.watched
    screen.render()
    assert not screen.shown and not screen.scheduler.watched


def test_a_changed_scene_is_rendered_anew(drawing):
    screen = Screen(drawing)
    screen.scheduler.ask("a", FIRST)
    screen.render()
    screen.scheduler.again()
    screen.scheduler.render_next(0)
    assert screen.shown[-1] == ("a", 0.1, 20)


def test_stopping_gives_up_the_coarse_picture_too(drawing):
    stop = threading.Event()
    screen = Screen(drawing, stop=stop)
    drawing.between = lambda rows: stop.set()
    screen.scheduler.ask("a", FIRST)
    assert not screen.scheduler.render_next(0)
    assert not screen.shown


def test_a_shot_wakes_who_waits_for_one(drawing):
    screen = Screen(drawing)
    threading.Timer(0.02, screen.scheduler.ask, ("a", FIRST)).start()
    assert screen.scheduler.render_next(20)
