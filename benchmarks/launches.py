"""Kernel launches of an iteration of each stage and of a picture, and the bytes that they move.

Traces, without a GPU, a steady iteration of DeVRF at the paper's sizes, and a film's picture at a
time that is known and at a new one, as a GPU would carry them out without CUDA graphs: on tensors
that have shapes and no memory, with Triton's kernels and static shapes, the colour network in
reduced precision. An operation of PyTorch counts as one launch unless it only makes a view or takes
memory; libraries may launch more. Each tensor that a launch reads or writes counts as moved once,
of a table that is looked up in the rows that are fetched. Held are images, fields, moments and, of
what moves, all frames at rest in half precision; taken is what an iteration needs at once beside
that.
"""

from __future__ import annotations

from harness import parser, report

# isort: split
import gc
import os
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

import torch
from lightning import Trainer
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from devrf.checkpoints.checkpoint import CheckpointMetadata, LoadedCheckpoint
from devrf.data.batch import all_pixels
from devrf.engine.stage import ScheduledStage
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.deformation_schedule import DeformationPhase
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.voxel_stage import field_optimizer
from devrf.ops.dispatch import using
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.renderer import Renderer
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.rendering.sampling import RenderSettings
from devrf.scenes.scene import OpticalFlow, Views

META = torch.device("meta")
# A scene of the paper: 400 × 400 pixels, 100 views at rest, 4 views of 50 frames.
PIXELS, AT_REST, MOVING, FRAMES = 400, 100, 4, 50
# The share of a stage's iterations at which it is traced: the finest grids are learned then.
LATE = 0.98
# Operations that launch nothing, beside those that make a view.
SILENT = {
    "aten::empty",
    "aten::empty_like",
    "aten::empty_strided",
    "aten::new_empty",
    "aten::new_empty_strided",
    "aten::detach",
    "aten::_unsafe_view",
    "aten::set_",
    "aten::resize_",
}
# What reads a number back; and a picture's samples, visible and coloured: some ten of each pixel.
WAITED_FOR, LISTED = "aten::_local_scalar_dense", 10 * PIXELS**2
# What reads the rows of a table that an index names, and what adds to them.
LOOKED_UP = {"aten::index", "aten::index_select", "aten::gather", "aten::embedding"}
ADDED_TO = {"aten::index_add_", "aten::index_put_", "aten::scatter_", "aten::scatter_add_"}
# Kernels that go through the whole of their grids; others look points up in them.
DENSE = ("adam", "variation")


@dataclass
class Count:
    """What an iteration launches.

    Attributes:
        torch: launches of PyTorch's operations, by name.
        triton: launches of Triton's kernels, by name.
        moved: bytes that they read and write.
        waits: how often the host waits for a number.
        held: bytes of tensors before the iteration.
        taken: the most bytes that it takes at once on top of them.
    """

    torch: Counter[str] = field(default_factory=Counter)
    triton: Counter[str] = field(default_factory=Counter)
    moved: int = 0
    waits: int = 0
    held: int = 0
    taken: int = 0

    @property
    def launches(self) -> int:
        """All of them."""
        return self.torch.total() + self.triton.total()


class Tracing(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the operations inside the context, and the launches told by :meth:`run`."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._before = held()
        self.count = Count(held=sum(self._before.values()))
        self._living: dict[int, int] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.name().split(".")[0]
        if name == WAITED_FOR:
            self.count.waits += 1
            return LISTED
        result = func(*args, **(kwargs or {}))
        for tensor in _tensors(result):
            self._note(tensor.untyped_storage())
        if not (func.is_view or name in SILENT or name.startswith("profiler::")):
            self.count.torch[name] += 1
            self.count.moved += _moved(name, args, result)
        return result

    def _note(self, storage: torch.UntypedStorage) -> None:
        """Count memory for as long as it lives; a view's, or an old tensor's, only once."""
        key = storage._cdata
        if key in self._living or key in self._before:
            return
        self._living[key] = storage.nbytes()
        weakref.finalize(storage, self._living.pop, key, None)
        self.count.taken = max(self.count.taken, sum(self._living.values()))

    def run(self, kernel: Any, programs: int, *args: Any, **constants: Any) -> None:
        """Stands in for ``devrf.accel.blocks.run``."""
        name = kernel.fn.__name__
        self.count.triton[name] += 1
        tensors = {id(value): value for value in args if isinstance(value, Tensor)}
        dense, points = any(word in name for word in DENSE), max(map(_points, tensors.values()))
        for tensor in tensors.values():
            whole = _size(tensor)
            if tensor.dim() == 4 and not dense:
                whole = min(whole, 8 * points * tensor.shape[3] * tensor.element_size())
            self.count.moved += whole


def held() -> dict[int, int]:
    """The bytes of every tensor's memory, by its address, on the device that is traced for."""
    gc.collect()
    tensors = [one for one in gc.get_objects() if issubclass(type(one), Tensor) and one.is_meta]
    return {one.untyped_storage()._cdata: one.untyped_storage().nbytes() for one in tensors}


def _moved(name: str, args: Any, result: Any) -> int:
    given, made = sum(map(_size, _tensors(args))), sum(map(_size, _tensors(result)))
    if name in LOOKED_UP:
        return given - _size(args[0]) + 2 * made
    if name in ADDED_TO:
        values = args[2] if name == "aten::index_put_" else args[3]
        return given - _size(args[0]) + 2 * (_size(values) if isinstance(values, Tensor) else 0)
    return given + made


def _points(tensor: Tensor) -> int:
    """How many points, samples or rays a list has; none are in a grid."""
    return len(tensor) if 0 < tensor.dim() < 3 else 0


def _size(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()


def _tensors(values: Any) -> Iterator[Tensor]:
    if isinstance(values, Tensor):
        yield values
    elif isinstance(values, list | tuple):
        for value in values:
            yield from _tensors(value)


@contextmanager
def tracing() -> Iterator[Tracing]:
    """Count launches; Triton's kernels do not run."""
    from devrf.accel import blocks

    trace, usual = Tracing(), blocks.run
    blocks.run = trace.run
    try:
        with trace:
            yield trace
    finally:
        blocks.run = usual


def views(count: int, frames: int, *, flow: bool) -> Views:
    """``count`` images of each of ``frames`` times, without memory."""
    total = count * frames
    shape = total, PIXELS, PIXELS
    motion = OpticalFlow(
        torch.empty(*shape, 2, device=META), torch.empty(shape, dtype=torch.bool, device=META)
    )
    number = torch.arange(total, device=META)
    return Views(
        torch.empty(*shape, 4, dtype=torch.uint8, device=META),
        Cameras(
            torch.empty(total, 3, 4, device=META),
            torch.empty(total, 2, device=META),
            torch.empty(total, 2, device=META),
            PIXELS,
            PIXELS,
        ),
        torch.empty(total, device=META),
        number,
        tuple(map(str, range(total))),
        flow=motion if flow else None,
        frames=number,
    )


def model() -> DeVRFModel:
    """The field at rest at the paper's size."""
    box, architecture = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), Architecture()
    side = round(CanonicalSchedule().side)
    with META:
        return DeVRFModel(
            architecture,
            architecture.radiance_field(box, side**3, side**3),
            Occupancy.full((side, side, side), box),
            RenderSettings(step=0.5, alpha_threshold=1e-4, near=1.0, far=6.0),
        )


def canonical() -> ScheduledStage:
    """The canonical stage late in its schedule."""
    stage = CanonicalStage(decoder_precision="bfloat16")
    images = views(AT_REST, 1, flow=False)
    _attach(stage, images)
    stage.scene_model = model()
    stage.optimizer = field_optimizer(stage.scene_model.canonical, stage.rates)
    stage.iteration = int(LATE * stage.total_iterations)
    stage.phase = stage.phase_at(stage.iteration)
    stage.pool = all_pixels(images, torch.arange(len(images), device=META))
    # Where samples may be is not known here: gradients are counted as read everywhere.
    stage._look_for_gradients = lambda: None  # type: ignore[method-assign]
    stage.setup_optimizer()
    return stage


def deformation() -> ScheduledStage:
    """The deformation stage late in its schedule."""
    metadata = CheckpointMetadata("scene", "", "canonical", {})
    stage = DeformationStage(
        LoadedCheckpoint(metadata, model()), flow_mean="samples", decoder_precision="bfloat16"
    )
    images = views(MOVING, FRAMES, flow=True)
    _attach(stage, images)
    clock, side = (
        FrameClock(tuple(k / FRAMES for k in range(FRAMES))),
        stage.schedule.levels[-1].side,
    )
    with META:
        field = stage.scene_model.deformation = DeformationField(
            stage.scene_model.box, clock, voxels=side**3
        )
        field.frames.offload(on_host=False, half=True)
    stage.iteration = int(LATE * stage.total_iterations)
    phase = stage.phase = stage.phase_at(stage.iteration)
    assert isinstance(phase, DeformationPhase)
    stage._activate(phase)
    stage.previous_images = torch.arange(len(images), device=META)
    for frame in stage.active:
        frame.pools = [all_pixels(images, torch.arange(1, device=META))]
    return stage


def _attach(stage: ScheduledStage, images: Views) -> None:
    """Give a stage what Lightning gives it, as far as an iteration needs it."""
    stage.to(META)
    data = SimpleNamespace(
        scene=SimpleNamespace(background="white"), training_views=lambda capture, device: images
    )
    strategy = SimpleNamespace(backward=lambda loss, _, gradient: loss.backward(gradient))
    stage._trainer = cast(Trainer, SimpleNamespace(datamodule=data, strategy=strategy))


STAGES: dict[str, Callable[[], ScheduledStage]] = {
    "canonical": canonical,
    "deformation": deformation,
}
PICTURES = {"picture, known time": 0.5, "picture, new time": 0.3}


def picture(time: float) -> Count:
    """The launches of a film's picture at ``time``, one at 0.5 having been rendered."""
    scene, clock = model(), FrameClock(tuple(k / FRAMES for k in range(FRAMES)))
    with META:
        voxels = scene.canonical.voxels
        scene.deformation = DeformationField(scene.box, clock, voxels=voxels)
        scene.deformation.frames.offload(on_host=False, half=True)
    cameras, renderer = views(1, 1, flow=False).cameras, Renderer(scene, half=True)

    def suffices(capacity: SampleCapacity) -> bool:
        trace.count.waits += 1
        return not capacity._set_lengths(LISTED, LISTED, capacity.WASTE)

    with patch.object(SampleCapacity, "suffices", suffices):
        for shown in (0.5, time):  # lists are long enough for the second
            with tracing() as trace:
                renderer.view(cameras, 0, shown, 1.0)
    return trace.count


def traced(name: str) -> Count:
    """The launches of a steady iteration of a stage, or of a picture."""
    os.environ["TRITON_INTERPRET"] = "1"  # lets kernels be chosen for tensors of no GPU
    with using("triton"):
        if name in PICTURES:
            return picture(PICTURES[name])
        stage = STAGES[name]()
        optimizer = cast(LightningOptimizer, stage.optimizer)
        images = stage.trainer.datamodule.training_views(stage.capture, META)  # type: ignore[attr-defined]
        for _ in range(2):  # the first makes what later ones find
            with tracing() as trace:
                stage.loop.step(stage, images, optimizer)
    return trace.count


def main() -> None:
    """Print the counts."""
    arguments = parser(__doc__, overrides=False)
    arguments.add_argument("--names", action="store_true", help="print the launches by name")
    given = arguments.parse_args()
    rows = []
    for name in (*STAGES, *PICTURES):
        count = traced(name)
        rows.append(
            {
                "of": name,
                "launches": count.launches,
                "of PyTorch": count.torch.total(),
                "of Triton": count.triton.total(),
                "waits": count.waits,
                "MB moved": count.moved / 1e6,
                "GB held": count.held / 1e9,
                "GB taken": count.taken / 1e9,
            }
        )
        if given.names:
            both = (count.torch + count.triton).most_common()
            print(name, *(f"{number} {launched}" for launched, number in both), sep="\n  ")
    report(rows, given.json or Path("benchmark_launches.json"), META)


if __name__ == "__main__":
    main()
