"""Loss curves by graphs, kernels and precision, side by side; and whether they repeat."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import mean
from typing import Any

from devrf.evaluation.held_out import HeldOutView, score
from devrf.rendering.renderer import Renderer
from devrf.selfcheck.bench import Bench, Learned, Way, same_bits, tensors_of
from devrf.selfcheck.finding import Finding

# Every way is compared with PyTorch, one iteration after another, in single precision.
REFERENCE = Way()
WAYS = (
    REFERENCE,
    Way(precision="bfloat16"),
    *(
        Way("triton", graphs, precision)
        for graphs in ("off", "auto")
        for precision in ("float32", "bfloat16")
    ),
)
# Shares by which losses may be off the reference's: of the first Lightning step, before roundings
# add up, and of the last quarter's mean.
AT_FIRST, AT_LAST = 0.02, 0.05
# The last quarter's mean loss is this share of the first step's, or less.
FALLEN = 0.8


def curve_name(stage: str, way: Way) -> str:
    """The name of the check of a stage's curve."""
    return f"curve {stage} {way.in_words}"


def curve(bench: Bench, name: str, way: Way, earlier: Mapping[str, Mapping[str, Any]]) -> Finding:
    """Whether a stage learns, and along the curve of the reference.

    Args:
        bench: what is learned.
        name: of the stage.
        way: how its iterations are carried out.
        earlier: figures of earlier checks, by their names: the reference's curve.
    """
    learned = bench.learn(bench.build(name, way, bench.below(name)), way)
    losses, loop = learned.losses, learned.stage.loop
    tail = mean(losses[-max(1, len(losses) // 4) :]) if losses else math.nan
    view = _last_view(bench, learned)
    figures = {
        "losses": losses,
        "iterations": learned.stage.iteration,
        "seconds": round(learned.seconds, 3),
        "iterations_per_second": round(learned.stage.iteration / learned.seconds, 1),
        "psnr": round(view.psnr, 3),
        "rest_pose_psnr": round(view.rest_pose_psnr, 3),
        "graph_captures": loop.num_captures,
        "short_lists": loop.num_short_lists,
        "micro_batches": loop.micro_batching.count,
    }
    faults = _faults(losses, tail)
    if way != REFERENCE:
        known = earlier.get(curve_name(name, REFERENCE), {}).get("losses")
        faults += _differences(losses, known)
    if way.graphs == "auto" and not loop.num_captures:
        faults.append("no CUDA graph was captured")
    said = f"loss {losses[0]:.4f} to {tail:.4f}, {view.psnr:.2f} dB" if losses else "no loss"
    said += f", {figures['iterations_per_second']:.0f} iterations/s"
    return Finding(not faults, "; ".join([said, *faults]), figures)


def _last_view(bench: Bench, learned: Learned) -> HeldOutView:
    """The last held-out image of what the stage learns from, scored."""
    stage, scene = learned.stage, bench.scene
    views = scene.capture(stage.scored_capture).test
    model = stage.current_model()
    assert hasattr(model, "to")
    renderer = Renderer(model.to(bench.device))
    return score(renderer, views, len(views) - 1, scene.background)


def _faults(losses: Sequence[float], tail: float) -> list[str]:
    if not losses or not all(map(math.isfinite, losses)):
        return ["not every loss is finite"]
    return [] if tail <= FALLEN * losses[0] else ["the loss did not fall"]


def _differences(losses: Sequence[float], reference: Sequence[float] | None) -> list[str]:
    if not reference:
        return ["there is no curve of PyTorch to compare with"]
    if len(losses) != len(reference):
        return [f"{len(losses)} steps, PyTorch took {len(reference)}"]
    found = []
    quarter = max(1, len(losses) // 4)
    parts = (
        ("first step", AT_FIRST, losses[:1], reference[:1]),
        ("last quarter", AT_LAST, losses[-quarter:], reference[-quarter:]),
    )
    for part, most, ours, theirs in parts:
        off = abs(mean(ours) / mean(theirs) - 1)
        if not off <= most:
            found.append(f"{part} {100 * off:.1f} % off PyTorch's curve")
    return found


def determinism(bench: Bench, name: str) -> Finding:
    """Whether ``deterministic=true`` gives equal bits twice."""
    way = Way("auto", "auto", "auto", deterministic=True)
    below = bench.below(name)
    first, second = (bench.learn(bench.build(name, way, below), way) for _ in range(2))
    same = same_bits(tensors_of(first.stage), tensors_of(second.stage))
    same_losses = first.losses == second.losses
    said = "equal bits twice" if same and same_losses else "two runs differ"
    figures = {"same_fields": same, "same_losses": same_losses, "seconds": first.seconds}
    return Finding(same and same_losses, said, figures)
