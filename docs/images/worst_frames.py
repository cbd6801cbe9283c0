"""The worst held-out frame of a run, and the same frame after another: ``worst_frames.png``.

Give runs in pairs, the earlier way of learning first, such as those of the quality table::

    python -m devrf -m experiment=quality_table hydra.sweep.dir=outputs/quality_table
    cd outputs/quality_table
    python ../../docs/images/worst_frames.py 0_robot_ablation_paper_terms 9_robot_ablation_best …
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from make import HERE, opened, write_small
from torch import Tensor

from devrf.apps.images import error_colors, image_grid, scaled
from devrf.evaluation.held_out import HeldOutView, score
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

HEADINGS = ["truth", "before", "after", "error before", "error after"]
HEIGHT = 240


def held_out(run: Path) -> tuple[Scene, Callable[[int], HeldOutView]]:
    """A run's scene, and its dynamic held-out image of a number as the run shows it."""
    data, model = opened(run)
    scene, renderer = data.scene, Renderer(model)
    return scene, lambda k: score(renderer, scene.dynamic.test, k, scene.background)


def row(before: Path, after: Path) -> tuple[list[Tensor], list[str]]:
    """The worst frame of one run beside that of another: images, and lines that name them."""
    scene, earlier = held_out(before)
    _, later = held_out(after)
    frames = range(len(scene.dynamic.test))
    worst, one = min(((k, earlier(k)) for k in frames), key=lambda shown: shown[1].psnr)
    other = later(worst)
    errors = [error_colors(view.compared, view.truth) for view in (one, other)]
    images = [one.truth, one.prediction, other.prediction, *errors]
    lines = [scene.name, f"frame {worst}", f"{one.psnr:.2f} dB", f"{other.psnr:.2f} dB"]
    return [scaled(image, HEIGHT) for image in images], lines


def main(runs: Sequence[Path]) -> None:
    """Write ``worst_frames.png`` of pairs of runs."""
    rows = [row(*pair) for pair in zip(runs[::2], runs[1::2], strict=True)]
    images, labels = zip(*rows, strict=True)
    write_small(HERE / "worst_frames.png", image_grid(images, HEADINGS, labels))


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
