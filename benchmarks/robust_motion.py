"""Shows how much of a motion is found by chance: scenes × seeds, and the frames that are lost.

Each run is a command of its own, on one core, in a folder named by scene, seed and what is typed:
what was learned is kept, and the same command goes on where it was ended. For each scene, over
its seeds, it tells the mean PSNR of the held-out view in motion, of each seed; the worst frame;
and how many frames are lost: more than 4 dB below the median frame of the same view, or of the
training views.

    python benchmarks/robust_motion.py experiment=best_small          # eight bodies, three seeds
    python benchmarks/robust_motion.py --small                        # minutes
    python benchmarks/robust_motion.py --scene flag=PATH experiment=best_small data.downscale=1
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from harness import parser, report

from devrf.apps.report.runs import metric_over_time
from devrf.callbacks.frame_fit import lost

REPOSITORY = Path(__file__).resolve().parent.parent
# Bodies put together at random; half of them move twice as far from frame to frame.
BODIES = range(8)
FRAMES = 28
SMALL = ("experiment=quickstart", "data.width=48", "data.height=48")
# Nothing is filmed.
ALWAYS = ("video.frames=1", "trainer=cpu")


@dataclass(frozen=True)
class Case:
    """A scene, by its name in the table, and what is typed to learn it."""

    name: str
    words: tuple[str, ...]


def bodies(numbers: Sequence[int]) -> Iterator[Case]:
    """Bodies put together at random, without flow; the odd ones lack every second frame."""
    for number in numbers:
        frames = FRAMES // 2 if number % 2 else FRAMES
        words = ("data=procedural", "data.shape=random", "data.flow=none")
        chosen = (f"data.scene_seed={number}", f"data.frames={frames}")
        fast = ", fast" if number % 2 else ""
        yield Case(f"body {number}{fast}", (*words, *chosen))


def main() -> None:
    """Learn what is asked for, print the table, and write it as JSON."""
    arguments = parser(__doc__)
    arguments.add_argument(
        "--scene", action="append", default=[], metavar="NAME=PATH", help="in place of the bodies"
    )
    arguments.add_argument("--bodies", type=int, nargs="*", default=[*BODIES], help="which")
    arguments.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    arguments.add_argument("--into", type=Path, default=REPOSITORY / "outputs" / "robust_motion")
    arguments.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    arguments.add_argument("--small", action="store_true", help="two bodies, small and fast")
    options = arguments.parse_args()
    cases = [*bodies(options.bodies[:2] if options.small else options.bodies)]
    if options.scene:
        named = [scene.partition("=") for scene in options.scene]
        cases = [Case(name, ("data=inward", f"data.root={path}")) for name, _, path in named]
    words = [*(SMALL if options.small else ()), *options.overrides, *ALWAYS]
    work = [(case, seed) for case in cases for seed in options.seeds]
    into = options.into.resolve()
    with ThreadPoolExecutor(options.jobs) as pool:
        begun = [pool.submit(learned, case, seed, words, into) for case, seed in work]
        done = [future.result() for future in begun]
    rows = []
    for case in cases:
        runs = [figures for (of, _), figures in zip(work, done, strict=True) if of == case]
        if known := [figures for figures in runs if figures is not None]:
            rows.append(row(case.name, known))
    report(rows, options.json or into / "robust_motion.json", torch.device("cpu"), typed=words)
    sys.exit(any(figures is None for figures in done))


def learned(case: Case, seed: int, words: Sequence[str], into: Path) -> dict[str, Any] | None:
    """The figures of one run, which is learned first where it was not; None: it has failed."""
    typed = hashlib.sha256(" ".join([*case.words, *words]).encode()).hexdigest()[:8]
    folder = into / f"{case.name.replace(', ', '-').replace(' ', '-')}-seed-{seed}-{typed}"
    if not (folder / "metrics.json").exists():
        command = [sys.executable, "-m", "devrf", *case.words, *words]
        command += [f"seed={seed}", f"hydra.run.dir={folder}"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY / "src")}
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if run.returncode:
            print(f"{case.name}, seed {seed}: {run.stderr.strip().splitlines()[-1]}", flush=True)
            return None
    metrics = json.loads((folder / "metrics.json").read_text())["dynamic"]
    held_out = dict(enumerate(metric_over_time(folder, "psnr")))
    figures = {
        "psnr": metrics["psnr"],
        "rest_pose_psnr": metrics["rest_pose_psnr"],
        "worst": min(held_out.values()),
        "lost": len(lost(held_out)),
        "lost_training": metrics["lost_frames"],
        "seconds": metrics["seconds"],
    }
    print(f"{case.name}, seed {seed}: {figures}", flush=True)
    return figures


def row(name: str, runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A scene's figures over the seeds that did not fail; lost frames are those of all of them."""
    psnr = [figures["psnr"] for figures in runs]
    return {
        "scene": name,
        "at rest": fmean(figures["rest_pose_psnr"] for figures in runs),
        "PSNR by seed": ", ".join(f"{value:.2f}" for value in psnr),
        "mean": f"{fmean(psnr):.2f}",
        "spread": max(psnr) - min(psnr),
        "worst frame": min(figures["worst"] for figures in runs),
        "lost, held out": sum(figures["lost"] for figures in runs),
        "lost, training": sum(figures["lost_training"] for figures in runs),
        "seconds": fmean(figures["seconds"] for figures in runs),
    }


if __name__ == "__main__":
    main()
