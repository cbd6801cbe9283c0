"""Microseconds of the CPU that an iteration takes beside its kernels, without a GPU.

Learns both stages of a tiny scene with the real Trainer and the default callbacks, with static
shapes as on a GPU. Where a GPU would replay a graph nothing is done but the iteration before the
first replay of a visit, whose time is left out, as is that of entering visits; pixels are drawn,
rates set, losses logged, frames changed. A GPU waits for the host where this takes longer than
its kernels.
"""

from __future__ import annotations

import harness

# isort: split
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch

from devrf.engine.stage import ScheduledStage
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.voxel_stage import VoxelStage
from devrf.system.graphs import GraphedStep

TINY = (
    "experiment=paper data=procedural data.width=16 data.height=16 data.static_views=4 "
    "data.frames=8 data.static_test_views=1 video.frames=1 trainer=cpu logger=csv "
    "decoder_precision=float32 schedule.canonical.side=8 schedule.canonical.search_side=8 "
    "schedule.canonical.search_iterations=0 schedule.canonical.visual_hull_init=true "
    "schedule.canonical.occupancy_every=null schedule.canonical.density_drop=0 "
    "schedule.canonical.upsample_at=[20,40] "
    "schedule.canonical.rays=16 schedule.deformation.rays=16 schedule.deformation.levels.1.side=4 "
    "schedule.deformation.levels.2=null schedule.deformation.levels.3=null "
    "schedule.deformation.levels.4=null schedule.deformation.levels.5=null"
).split()


class Clock:
    """Counts the seconds of CPU that stages take, but for what is real work here."""

    def __init__(self) -> None:
        self.seconds, self.visits, self.visiting, self.iterations = 0.0, 0, 0.0, 0

    def replaces(self, stack: ExitStack) -> None:
        """Time stages, and stub the replay of graphs."""
        usual = GraphedStep.__call__

        def replay(graphed: GraphedStep) -> None:
            if graphed._calls:
                graphed._calls += 1
                return
            began = time.process_time()
            usual(graphed)
            self.seconds -= time.process_time() - began

        stack.enter_context(patch.object(GraphedStep, "__call__", replay))
        stack.enter_context(patch.object(VoxelStage, "static_shape", True))
        for name, sign in (("on_train_start", -1), ("on_train_end", 1)):
            stack.enter_context(patch.object(ScheduledStage, name, self._at(name, sign)))
        for stage in (CanonicalStage, DeformationStage):
            stack.enter_context(patch.object(stage, "enter", self._entering(stage.enter)))

    def _at(self, name: str, sign: int) -> Any:
        usual = getattr(ScheduledStage, name)

        def method(stage: ScheduledStage) -> None:
            usual(stage)
            self.seconds += sign * time.process_time()
            self.iterations += sign * stage.iterations_done

        return method

    def _entering(self, usual: Any) -> Any:
        def method(stage: ScheduledStage, phase: Any) -> None:
            began = time.process_time()
            usual(stage, phase)
            spent = time.process_time() - began
            self.visits, self.visiting = self.visits + 1, self.visiting + spent
            self.seconds -= spent

        return method


def rows(folder: Path, iterations: int) -> Iterator[dict[str, Any]]:
    """Of each stage, with 10 and 50 iterations a Lightning step."""
    lengths = {"canonical": iterations, "deformation.levels.1": iterations // 10}
    lasts = [f"schedule.{key}.iterations={length}" for key, length in lengths.items()]
    for count in (10, 50):
        for stage in ("canonical", "deformation"):
            steps = [f"{key}.iterations_per_step={count}" for key in ("canonical", "deformation")]
            into = f"hydra.run.dir={folder / str(count)}"
            run = harness.open_run([*TINY, *lasts, *steps, f"stage={stage}", into])
            clock = Clock()
            with ExitStack() as stack:
                clock.replaces(stack)
                harness.run_stage(run.config, run.folder)
            yield {
                "stage": stage,
                "iterations a step": count,
                "us an iteration": 1e6 * clock.seconds / clock.iterations,
                "visits": clock.visits,
                "ms a visit": 1e3 * clock.visiting / max(clock.visits, 1),
            }


def main() -> None:
    """Report both stages."""
    arguments = harness.parser(__doc__, overrides=False)
    arguments.add_argument("--iterations", type=int, default=2000, help="of the canonical stage")
    given = arguments.parse_args()
    torch.set_num_threads(1)
    with TemporaryDirectory() as folder:
        into = given.json or Path("outputs/benchmarks/host.json")
        harness.report([*rows(Path(folder), given.iterations)], into, torch.device("cpu"))


if __name__ == "__main__":
    main()
