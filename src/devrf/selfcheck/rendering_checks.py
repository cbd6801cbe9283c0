"""Pictures of both implementations, and frames a second."""

from __future__ import annotations

from statistics import median
from typing import Any

import torch
from torch.utils.benchmark import Timer

from devrf.evaluation.held_out import background_value
from devrf.methods.devrf.model import DeVRFModel
from devrf.ops.dispatch import Kind, using
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Views
from devrf.selfcheck.bench import Bench, Way
from devrf.selfcheck.finding import Finding

# Grey levels by which a picture may be off that of PyTorch in single precision, in the mean over
# the pixels: a sample at a threshold may be kept by one implementation alone.
SINGLE, HALF = 1e-3, 5e-3
# Rows of a picture on a GPU, as in the paper's videos.
ROWS = 400


def frames(bench: Bench) -> Finding:
    """Whether every renderer shows what PyTorch shows; how many frames a second."""
    way = Way()
    stage = bench.deformation(bench.rest(), way)
    bench.learn(stage, way)
    model = stage.current_model().to(bench.device)
    views, behind = bench.scene.dynamic.test, background_value(bench.scene.background)
    ways: list[tuple[str, Kind, bool]] = [("torch", "torch", False)]
    if bench.device.type == "cuda":
        ways += [("triton", "triton", False), ("triton, float16 decoder", "triton", True)]
    expected = _picture(model, views, behind, "torch", half=False)
    found: dict[str, Any] = {}
    faults = []
    for name, kind, half in ways:
        shown = _picture(model, views, behind, kind, half=half)
        off = float((shown - expected).abs().mean())
        if not off <= (HALF if half else SINGLE):
            faults.append(f"{name}: {off:.2g} off PyTorch's picture")
        found[name] = {"off": off, **_speed(model, views, behind, kind, half=half)}
    last = list(found)[-1]
    pixels = found[last]["pixels"]
    said = f"{found[last]['new_time']:.1f} frames/s at new times, {found[last]['same_time']:.1f} "
    said += f"at known ones ({last}, {pixels[0]}x{pixels[1]})"
    return Finding(not faults, "; ".join([said, *faults]), found)


def _picture(
    model: DeVRFModel, views: Views, behind: float, kind: Kind, *, half: bool
) -> torch.Tensor:
    """What the last held-out camera sees, (H·W, 3)."""
    last = len(views) - 1
    with using(kind):
        seen = Renderer(model, half=half).view(
            views.cameras, last, float(views.times[last]), behind
        )
    return seen.color.float()


def _speed(
    model: DeVRFModel, views: Views, behind: float, kind: Kind, *, half: bool
) -> dict[str, Any]:
    """Frames a second: medians over times, the first time and again."""
    on_gpu = model.device.type == "cuda"
    cameras = views.cameras.of_height(ROWS) if on_gpu else views.cameras
    renderer = Renderer(model, half=half)
    first, again = [], []
    with using(kind):
        for index in range(0, len(views), max(1, len(views) // 4)):
            camera = cameras, index, float(views.times[index]), behind
            timer = Timer(
                "renderer.view(*camera)", globals={"renderer": renderer, "camera": camera}
            )
            renderer.view(*camera)  # compiles kernels, and makes lists long enough
            renderer.at.cache_clear()
            first.append(timer.timeit(1).median)
            again.append(timer.timeit(3 if on_gpu else 1).median)
    return {
        "pixels": [cameras.width, cameras.height],
        "new_time": round(1 / median(first), 2),
        "same_time": round(1 / median(again), 2),
    }
