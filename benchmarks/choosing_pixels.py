"""Seconds to carve a scene's static hull, and to choose the pixels that are learned from.

Pixels are chosen at grids of several sides, with blocks as large as they are allowed to be and with
the smallest.

    python benchmarks/choosing_pixels.py data.root=PATH
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import torch
from harness import open_run

from devrf.methods.devrf import pixel_pools
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import RenderSettings
from devrf.scenes.silhouettes import visual_hull

SIDES = (50, 80, 160)
ROUNDS = 3
Result = TypeVar("Result")


def main() -> None:
    """Measure the scene that the command line names."""
    with tempfile.TemporaryDirectory() as folder:
        scene = open_run([*sys.argv[1:], "trainer=cpu", f"hydra.run.dir={folder}"]).scene
    views = scene.static.train
    box = scene.bounds.box
    hull, seconds = timed(lambda: visual_hull(views, box, box.grid_shape(SIDES[0] ** 3)))
    print(f"{len(views)} images of {views.width}x{views.height}: hull {seconds:.2f} s")
    settings = RenderSettings(0.5, 1e-3, scene.bounds.near, scene.bounds.far)
    field = Architecture().search_field(box, SIDES[0] ** 3)
    carved = Occupancy(hull, box)
    model = DeVRFModel(Architecture(), field, carved, settings, space=scene.space)
    images = torch.arange(len(views))
    largest = pixel_pools.MOST_BLOCK
    for side in SIDES:
        occupancy = Occupancy(carved.on(box.grid_shape(side**3), box), box)
        for most in (pixel_pools.BLOCK, largest):  # as it was in the end
            pixel_pools.MOST_BLOCK = most
            block = pixel_pools.block_size(views.cameras, model, occupancy)
            choose = partial(pixel_pools.rays_hit_occupied, views.cameras, images, model, occupancy)
            hit, seconds = timed(choose)
            share = float(hit.float().mean())
            print(f"side {side}, blocks of {block}: {seconds:.2f} s, {100 * share:.2f} % of pixels")


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """What ``work`` gives, and its seconds: the least of some rounds."""
    best = float("inf")
    for _ in range(ROUNDS):
        began = time.perf_counter()
        result = work()
        best = min(best, time.perf_counter() - began)
    return result, best


if __name__ == "__main__":
    main()
