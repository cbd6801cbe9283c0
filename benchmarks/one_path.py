"""Iterations and pictures of the quickstart by this source tree and by another, in turns.

Each turn is a process of its own for each tree; the table has medians over the turns:

- ``canonical``, ``deformation``: milliseconds of an iteration, forward and backward, and of the
  optimiser's step, over a whole stage that neither scores nor draws.
- ``known time``, ``new time``: milliseconds of a 400x400 picture of the robot, at a time whose
  occupancy and displacements are at hand, and at one that was not shown before.

    python benchmarks/one_path.py --other PATH_OF_A_CHECKOUT --threads 1 2 --turns 5
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

HERE = Path(__file__).resolve()
# What a worker prints its result behind.
MARK = "result: "
PICTURE = 400
ROUNDS = 15


def main() -> None:
    """Compare the trees that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--other", type=Path, help="a checkout of another revision")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--json", type=Path, help="where the results are written")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker is not None:
        print(MARK + json.dumps(measured(options.worker)))
        return
    trees = {"this": HERE.parent.parent}
    if options.other is not None:
        trees["other"] = options.other.resolve()
    rows = []
    for threads in options.threads:
        results: dict[str, list[dict[str, float]]] = {name: [] for name in trees}
        for _ in range(options.turns):
            for name, tree in trees.items():
                results[name].append(in_process(tree, threads))
        for part in results["this"][0]:
            row: dict[str, object] = {"threads": threads, "ms of": part}
            for name, turns in results.items():
                row[name] = median(turn[part] for turn in turns)
            if "other" in row:
                row["ratio"] = row["this"] / row["other"]  # type: ignore[operator]
            rows.append(row)
            print("  ".join(f"{k}: {v:.3g}" if k != "ms of" else str(v) for k, v in row.items()))
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


def in_process(tree: Path, threads: int) -> dict[str, float]:
    """What a source tree takes, measured in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "OMP_NUM_THREADS": str(threads)}
    with tempfile.TemporaryDirectory() as folder:
        # Its own copy of this script, which knows its names.
        command = [sys.executable, str(tree / "benchmarks" / HERE.name), "--worker", folder]
        done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith(MARK)]
    if not lines:
        raise SystemExit(f"{tree}: {done.stderr[-2000:]}")
    result: dict[str, float] = json.loads(lines[-1].removeprefix(MARK))
    return result


def measured(folder: Path) -> dict[str, float]:
    """Milliseconds by name, of the source tree that is on the path."""
    import time
    from typing import Any

    import torch
    from harness import open_run
    from hydra.utils import instantiate
    from lightning import Callback
    from torch.optim.optimizer import register_optimizer_step_post_hook

    from devrf.callbacks import GridUpscaling, LearningRateDecay
    from devrf.rendering.renderer import Renderer

    class Clock(Callback):
        """Seconds in optimisers' steps."""

        def __init__(self) -> None:
            self.began = self.spent = 0.0

        def on_before_optimizer_step(self, *args: Any) -> None:
            self.began = time.perf_counter()

        def stop(self, *args: Any) -> None:
            if self.began:
                self.spent += time.perf_counter() - self.began
                self.began = 0.0

    run = open_run(["experiment=quickstart", f"hydra.run.dir={folder}/run", "trainer=cpu"])
    result: dict[str, float] = {}
    _ = run.scene

    def learn(stage: Any) -> None:
        clock = Clock()
        hook = register_optimizer_step_post_hook(clock.stop)
        trainer = instantiate(
            run.config.trainer,
            callbacks=[GridUpscaling(), LearningRateDecay(), clock],
            logger=False,
        )
        began = time.perf_counter()
        trainer.fit(stage, datamodule=run.datamodule)
        seconds = time.perf_counter() - began
        hook.remove()
        count = stage.position.iterations_done
        result[stage.name] = 1000 * (seconds - clock.spent) / count
        result[f"{stage.name}, optimiser"] = 1000 * clock.spent / count

    canonical = instantiate(run.config.canonical, _convert_="all")
    learn(canonical)
    build = instantiate(run.config.deformation, _partial_=True, _convert_="all")
    deformation = build(earlier=canonical.result())
    learn(deformation)
    cameras = run.scene.dynamic.test.cameras.of_height(PICTURE)
    renderer = Renderer(deformation.current_model())
    taken: dict[str, list[float]] = {"known time": [], "new time": []}
    for number in range(ROUNDS):
        moment = (number + 0.5) / ROUNDS
        for name in ("new time", "known time"):
            began = time.perf_counter()
            with torch.no_grad():
                renderer.view(cameras, 0, moment, 1.0)
            taken[name].append(1000 * (time.perf_counter() - began))
    return result | {name: median(times) for name, times in taken.items()}


if __name__ == "__main__":
    main()
