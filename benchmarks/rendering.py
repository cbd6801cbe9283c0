"""Frames a second of held-out views, at a new time and again at the same time.

A time's occupancy and displacements are computed once and cached, so that a camera path at one time
renders faster than a film in which each frame has another time.
"""

from __future__ import annotations

from harness import learned_scene, open_run, parser, report

# isort: split
from functools import partial
from statistics import median
from typing import Any

import torch
from torch.utils.benchmark import Timer

from devrf.cli.messages import report_user_errors
from devrf.evaluation.held_out import background_value
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Views


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


if __name__ == "__main__":
    main()
