"""Frames a second of held-out views, at a new time and again at the same time; and of a viewer.

A time's occupancy and displacements are computed once and cached, so that a camera path at one time
renders faster than a film in which each frame has another time. The viewer's frames are what the
server draws of 240 rows, 4:3, and encodes as PNG, as the camera turns about the world's upward
axis.
"""

from __future__ import annotations

from harness import learned_scene, open_run, parser, report

# isort: split
import math
import time
from functools import partial
from statistics import median
from typing import Any

import cv2
import torch
from torch.utils.benchmark import Timer

from devrf.apps.camera_paths import upward
from devrf.apps.keyframes import Keyframe
from devrf.apps.viewer.drawing import Drawing, Shot
from devrf.cli.messages import report_user_errors
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Views, background_value

# Frames of a viewer: so many, of so many rows; the degrees that its camera turns between two.
VIEWED = 20
ROWS = 240
TURN = 1.0


def main() -> None:
    """Render some held-out views of the run that the command line describes."""
    arguments = parser(__doc__)
    arguments.add_argument("--views", type=int, default=5, help="how many, from first to last")
    options = arguments.parse_args()
    with report_user_errors():
        run = open_run(options.overrides)
        model = learned_scene(run).model
        views = run.scene.dynamic.test
        background = background_value(run.scene.background)
        rows = [frames_a_second(Renderer(model), views, options.views, background)]
        rows.append(of_a_viewer(Drawing(Renderer(model, times=VIEWED), background), views))
        into = options.json or run.folder / "benchmark_rendering.json"
        report(rows, into, run.device, scene=run.scene.name, overrides=options.overrides)


def frames_a_second(
    renderer: Renderer, views: Views, count: int, background: float
) -> dict[str, Any]:
    """The medians over ``count`` of the views, evenly spaced."""
    first: list[float] = []
    again: list[float] = []
    threads = torch.get_num_threads()
    for index in torch.linspace(0, len(views) - 1, count).round().int().tolist():
        render = partial(
            renderer.view,
            views.cameras,
            index,
            time=float(views.times[index]),
            background=background,
        )
        timer = Timer("render()", globals={"render": render}, num_threads=threads)
        render()
        renderer.at.cache_clear()
        first.append(timer.timeit(1).median)
        again.append(timer.timeit(3).median)
    return {
        "width": views.width,
        "height": views.height,
        "views": count,
        "new time": 1 / median(first),
        "same time": 1 / median(again),
    }


def of_a_viewer(drawing: Drawing, views: Views) -> dict[str, Any]:
    """Frames a second while the camera turns, at one time and while time runs."""
    pose = views.cameras.camera_to_world[0]
    axis = upward(views.cameras)
    cross = torch.linalg.cross(axis.expand(3, 3), torch.eye(3), dim=1).T
    rates: dict[str, Any] = {"width": ROWS * 4 // 3, "height": ROWS, "views": VIEWED}
    for name, runs in (("camera turns", 0.0), ("time runs, too", 0.9 / VIEWED)):
        taken = []
        for k in range(VIEWED):
            turn = torch.linalg.matrix_exp(math.radians(TURN * k) * cross) @ pose
            shot = Shot(Keyframe(turn, fov=40.0, time=0.05 + runs * k, seconds=0.0), aspect=4 / 3)
            began = time.perf_counter()
            *_, frame = drawing.draw(shot, ROWS)
            assert frame is not None
            cv2.imencode(".png", frame.pixels.numpy())
            taken.append(time.perf_counter() - began)
        rates[name] = 1 / median(taken)
    return rates


if __name__ == "__main__":
    main()
