"""Milliseconds of a training iteration at each resolution of both stages, in total and by part.

The learned scene is resampled to each resolution, so that rays meet as many occupied cells as at
the end of training; the run's checkpoints are not changed.
"""

from __future__ import annotations

from harness import learned_scene, open_run, parser, report

# isort: split
import copy
from collections.abc import Callable
from typing import Any, get_args

import torch
from hydra.utils import instantiate
from lightning import Callback, LightningModule, Trainer
from torch.profiler import ProfilerActivity, profile, record_function
from torch.utils.benchmark import Timer

from devrf.callbacks import LearningRateDecay
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.cli.context import RunContext
from devrf.cli.messages import report_user_errors
from devrf.engine.schedule import Phase
from devrf.engine.stage import Stage
from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_schedule import CanonicalPhase
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationPhase
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.model import DeVRFModel
from devrf.system.profiling import Part

PARTS = get_args(Part)
# Time outside all parts: the loop, and Lightning around it.
OVERHEAD = "overhead"
Row = dict[str, Any]


def main() -> None:
    """Measure the stages of the run that the command line describes."""
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=float, default=2.0, help="of timing a resolution")
    options = arguments.parse_args()
    with report_user_errors():
        run = open_run(options.overrides)
        stored = learned_scene(run)
        rows = canonical_rows(run, stored, options.seconds)
        rows += deformation_rows(run, stored, options.seconds)
        into = options.json or run.folder / "benchmark_training.json"
        report(rows, into, run.device, scene=run.scene.name, overrides=options.overrides)


def canonical_rows(run: RunContext, stored: LoadedCheckpoint, seconds: float) -> list[Row]:
    """A row for the search, at its beginning, and one for each fine resolution."""

    def build() -> CanonicalStage:
        stage: CanonicalStage = instantiate(run.config.canonical, _convert_="all")
        return stage

    rows = measure(run, build(), "fine", stored.model, seconds)
    if build().schedule.phase(0).kind == "search":
        rows = measure(run, build(), "search", None, seconds) + rows
    return rows


def deformation_rows(run: RunContext, stored: LoadedCheckpoint, seconds: float) -> list[Row]:
    """A row for each level."""
    build = instantiate(run.config.deformation, _partial_=True, _convert_="all")
    return measure(run, build(earlier=copy.deepcopy(stored)), "level", stored.model, seconds)


def measure(
    run: RunContext, stage: Stage, kind: str, learned: DeVRFModel | None, seconds: float
) -> list[Row]:
    """The rows of a stage's phases whose name begins with ``kind``, coarse to fine."""
    measuring = MeasurePhases(kind, learned, seconds)
    trainer: Trainer = instantiate(
        run.config.trainer,
        callbacks=[measuring, LearningRateDecay()],
        logger=False,
        default_root_dir=str(run.folder),
    )
    trainer.fit(stage, datamodule=run.datamodule)
    if trainer.interrupted:
        raise KeyboardInterrupt
    return measuring.rows[::-1]


class MeasurePhases(Callback):
    """Replaces ``GridUpscaling``: enters and measures one phase of each resolution.

    Attributes:
        rows: one for each resolution, fine to coarse: fields are resampled downwards only.
    """

    def __init__(self, kind: str, learned: DeVRFModel | None, seconds: float) -> None:
        self.rows: list[Row] = []
        self._kind = kind
        self._learned = learned
        self._seconds = seconds

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Measure everything before the first step, which is also the last."""
        assert isinstance(pl_module, Stage)
        if self._learned is not None:
            give_fields(pl_module, copy.deepcopy(self._learned).to(pl_module.device))
        phases = one_phase_of_each_resolution(pl_module)
        for name in reversed([name for name in phases if name.startswith(self._kind)]):
            self.rows.append({"stage": pl_module.name, "phase": name})
            self.rows[-1] |= measure_phase(pl_module, phases[name], batch, self._seconds)
        trainer.should_stop = True


def one_phase_of_each_resolution(stage: Stage) -> dict[str, Phase]:
    """The middle one of a stage's phases at each resolution by its name, coarse to fine."""
    phases_by_name: dict[str, list[Phase]] = {}
    start = 0
    while start < stage.schedule.total:
        phase = stage.schedule.phase(start)
        name = phase.kind
        if isinstance(phase, CanonicalPhase):
            name += f" {phase.voxels}"
        phases_by_name.setdefault(name, []).append(phase)
        start = phase.stop
    return {name: phases[len(phases) // 2] for name, phases in phases_by_name.items()}


def give_fields(stage: Stage, learned: DeVRFModel) -> None:
    """Give a stage learned fields, as at the end of its last phase."""
    last = stage.schedule.phase(stage.schedule.total)
    model = stage.scene_model
    assert isinstance(model, DeVRFModel)
    model.canonical = learned.canonical
    model.occupancy = learned.occupancy
    if isinstance(stage, DeformationStage):
        assert isinstance(last, DeformationPhase)
        model.canonical.requires_grad_(False)
        model.deformation = learned.deformation or model.deformation
        if stage.field.shape != model.canonical.box.grid_shape(last.side**3):
            stage.field.resize(last.side**3)
    stage.phase = last


def measure_phase(stage: Stage, phase: Phase, views: Any, seconds: float) -> Row:
    """Time and memory of an iteration of ``phase``; then, under a profiler, its time by part."""
    stage.position.iteration = phase.start
    stage.enter(phase)
    count = min(stage.iterations_per_step, phase.stop - phase.start)

    def step() -> None:
        if stage.position.iteration + count > phase.stop:
            stage.position.iteration = phase.start
        stage.training_step(views, 0)
        if stage.abort_reason is not None:
            raise DevrfError(stage.abort_reason)

    cuda = stage.device.type == "cuda"
    for _ in range(3):  # the first are slower
        step()
    if cuda:
        torch.cuda.reset_peak_memory_stats(stage.device)
    timer = Timer("step()", globals={"step": step}, num_threads=torch.get_num_threads())
    timed = timer.blocked_autorange(min_run_time=seconds)
    row = {
        "grid": "x".join(str(points) for points in stage.scene_model.resolution),
        "ms": 1000 * timed.median / count,
        "iqr": 1000 * timed.iqr / count,
    }
    if cuda:
        row["gb"] = torch.cuda.max_memory_allocated(stage.device) / 1e9
    row |= {part: ms / count for part, ms in parts(step, cuda=cuda).items()}
    stage.position.iteration = phase.start  # of the phase that was entered
    return row


def parts(work: Callable[[], None], *, cuda: bool) -> dict[str, float]:
    """Milliseconds of ``work`` by part, each without the parts nested in it.

    On a CUDA device: of the kernels that a part launched. Autograd launches from its own thread,
    without named parts: all of it counts as ``backward``.
    """
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if cuda else [])]
    with profile(activities=activities) as profiled, record_function(OVERHEAD):
        work()
    events = [event for event in profiled.events() if event.device_type.name == "CPU"]
    main = next(event.thread for event in events if event.name == OVERHEAD)
    spent = dict.fromkeys((*PARTS, OVERHEAD), 0.0)
    for event in events:
        owner = event
        while owner.name not in spent and owner.cpu_parent is not None:
            owner = owner.cpu_parent
        default = OVERHEAD if event.thread == main else "backward"
        own = event.self_device_time_total if cuda else event.self_cpu_time_total
        spent[owner.name if owner.name in spent else default] += own / 1000
    return spent


if __name__ == "__main__":
    main()
