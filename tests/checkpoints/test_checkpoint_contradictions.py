"""Files with a right checksum whose parts contradict each other: taken, or refused in one line.

Each has one changed value. DEVRF_FUZZ_INPUTS says how many are tried, of which a quarter are
progress files.
"""

from __future__ import annotations

import math
import os
import random
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import reduce
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer
from lightning.pytorch.callbacks import LambdaCallback
from torch import Tensor

from devrf.apps.export.geometry import ExportSettings
from devrf.apps.export.scene import export_scene
from devrf.apps.web.pack import drawable, page
from devrf.callbacks import DivergenceGuard, Previews, TrainingRecord
from devrf.checkpoints.checkpoint import (
    ChecksummedCheckpointIO,
    load_checkpoint,
    metadata_in,
)
from devrf.checkpoints.checkpoint_file import read_checkpoint_file, write_checkpoint_file
from devrf.cli.resume import unfinished
from devrf.engine.stage import Stage, fit
from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.gaussians.model import DeformableGaussians
from devrf.methods.gaussians.settings import GaussiansSettings
from devrf.rendering.renderer import Renderer
from devrf.system.memory import own_memory
from devrf.system.stored_class import class_path

INPUTS = int(os.environ.get("DEVRF_FUZZ_INPUTS", "60"))
NUMBERS = [0, -1, 1, 0.5, 5e-324, 1e9, 1e30, 1e300, 2**63, math.nan, math.inf, True]
OTHERS = [None, "", "a", "../x", "\x1b[2J\n", [], [0], [[0] * 4] * 4, {}, {"": 1}]
TENSORS = [torch.zeros(()), torch.zeros(0), torch.ones(3), torch.ones(1, 1, 1, 1)]
LEFT_OUT = object()
Place = tuple[Any, ...]


def other_tensors(tensor: Tensor) -> Iterator[Tensor]:
    """Other shapes, types and values."""
    yield from (tensor[None], tensor.flatten(), tensor.double(), tensor.to(torch.uint8))
    yield from (torch.full_like(tensor, value) for value in (0, 1))
    if tensor.ndim:
        yield from (tensor[:0], tensor[:1], tensor.repeat_interleave(3, dim=0))
        yield tensor.transpose(0, -1)
    if tensor.is_floating_point():
        largest = torch.finfo(tensor.dtype).max
        yield from (torch.full_like(tensor, v) for v in (math.nan, math.inf, largest, -6e4))


def changes(value: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Each place in nested data, and what may stand there instead."""
    if place:
        yield from ((place, other) for other in (LEFT_OUT, *NUMBERS, *OTHERS, *TENSORS))
    if isinstance(value, Tensor) and value.ndim:
        yield from ((place, other) for other in other_tensors(value))
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from changes(item, (*place, key))
    elif isinstance(value, list | tuple) and len(value) < 8:
        for index, item in enumerate(value):
            yield from changes(item, (*place, index))


def changed(value: Any, place: Place, other: Any) -> Any:
    """A copy of nested data with something else in a place."""
    if not place:
        return other
    key, *rest = place
    copy = {**value} if isinstance(value, dict) else [*value]
    if other is LEFT_OUT and not rest:
        del copy[key]
    else:
        copy[key] = changed(value[key], tuple(rest), other)
    return tuple(copy) if isinstance(value, tuple) else copy


def try_all(path: Path, keys: tuple[str, ...], use: Callable[[], object], count: int) -> int:
    """Use so many changed copies of a file, of which ``keys`` change; how many are refused."""
    content = read_checkpoint_file(path)
    every = list(changes({key: content[key] for key in keys}))
    refused = 0
    for place, other in random.Random(0).sample(every, min(count, len(every))):
        write_checkpoint_file(path, changed(content, place, other))
        before = own_memory()
        began = time.perf_counter()
        where = f"{'/'.join(map(str, place))} = {other}"
        try:
            use()
        except DevrfError as error:
            message = str(error)
            assert message.isprintable(), where
            refused += 1
        except Exception as error:
            raise AssertionError(where) from error
        assert time.perf_counter() - began < 10 and own_memory() - before < 300e6, where
    return refused


@pytest.fixture
def moving(rest, datamodule, trainer, tmp_path) -> Path:
    """The checkpoint of a scene that moves."""
    schedule, learner = DeformationSchedule(levels=(Level(4, 2),), rays=64), trainer(max_epochs=1)
    learner.fit(DeformationStage(rest, schedule), datamodule=datamodule)
    learner.save_checkpoint(tmp_path / "deformation.ckpt", weights_only=True)
    return tmp_path / "deformation.ckpt"


@pytest.mark.filterwarnings("ignore")
def test_a_checkpoint_is_shown_or_refused(moving, tmp_path):
    def show() -> None:
        stored = load_checkpoint(moving)
        if stored.viewpoints is not None:
            camera = stored.viewpoints.held_out.of_height(12)
            for moment in (0.0, 0.3, 1.0):
                Renderer(stored.model).view(camera, index=0, time=moment, background=1.0)
            stored.model.forward_warp(0.7)(torch.zeros(2, 3))
            if drawable(stored.model):
                page(stored.model, stored.viewpoints, "a", "b")
            mesh = ExportSettings(side=8, faces=20, times=[0, 0.7])
            with suppress(DevrfError):  # there may be no surface
                export_scene(stored.model, stored.viewpoints, mesh, tmp_path / "export")

    count = INPUTS * 3 // 4
    assert try_all(moving, ("devrf", "state_dict", "viewpoints"), show, count) > count // 4


@pytest.mark.filterwarnings("ignore")
def test_gaussians_are_shown_or_refused(moving, tmp_path):
    model = DeformableGaussians(GaussiansSettings(width=8, depth=2, embedding=2, harmonics=1))
    model.cloud.begin(0.3 * torch.randn(50, 3), torch.rand(50, 3), torch.full((50,), 0.1), 0.5)
    content = read_checkpoint_file(moving)
    content["devrf"]["model"] = {"class": class_path(DeformableGaussians), **model.config()}
    content["state_dict"] = {f"scene_model.{k}": v for k, v in model.stored_state().items()}
    write_checkpoint_file(moving, content)

    def show() -> None:
        stored = load_checkpoint(moving)
        assert stored.viewpoints is not None
        camera = stored.viewpoints.held_out.of_height(12)
        for moment in (0.0, 0.7):
            Renderer(stored.model).view(camera, index=0, time=moment, background=1.0)
        splats = ExportSettings(format="splats", times=[0, 0.7])
        export_scene(stored.model, stored.viewpoints, splats, tmp_path / "splats")

    show()
    color = ("state_dict", "scene_model.cloud.color")
    write_checkpoint_file(moving, changed(content, color, torch.zeros(1, 3)))
    with pytest.raises(DevrfError, match="parts of other numbers of Gaussians"):
        show()
    nearest = ("state_dict", "scene_model.cloud.neighbours")
    write_checkpoint_file(moving, changed(content, nearest, torch.full((50, 6), 50)))
    with pytest.raises(DevrfError, match="neighbours that are no Gaussians"):
        show()
    write_checkpoint_file(moving, content)
    count = INPUTS // 8
    assert try_all(moving, ("devrf", "state_dict"), show, count) > count // 4


PLACES: list[Place] = [
    ("state_dict", "scene_model.deformation.frames.backward_slices", "kept"),
    ("state_dict", "scene_model.canonical.decoder.output.bias"),
    ("viewpoints", "static", "camera_to_world"),
    ("viewpoints", "held_out", "center"),
    ("viewpoints", "clock", "times", 1),
    ("viewpoints", "offset", 0),
]


def test_numbers_that_nothing_can_be_computed_with_are_one_line(moving):
    content = read_checkpoint_file(moving)
    for place in PLACES:
        part = reduce(lambda whole, key: whole[key], place, content)
        for value in (math.nan, math.inf, -math.inf, 1e30):
            other = part.float() * 0 + value if isinstance(part, Tensor) else value
            write_checkpoint_file(moving, changed(content, place, other))
            with pytest.raises(DevrfError, match="its parts do not fit together"):
                load_checkpoint(moving)
            if place[0] == "state_dict":  # as Lightning reads it, to go on
                with pytest.raises(ValueError, match="a number that is not finite, or too large"):
                    ChecksummedCheckpointIO().load_checkpoint(moving)


def test_settings_and_progress_are_looked_at_before_they_are_used(moving):
    """Settings are compared, and printed as JSON; the place where a stage was left is printed."""
    content = read_checkpoint_file(moving)
    for value in ({1, 2}, torch.zeros(3)):
        write_checkpoint_file(moving, changed(content, ("devrf", "training_config"), {"a": value}))
        with pytest.raises(DevrfError, match="do not fit together .*training_config: a: "):
            metadata_in(moving, read_checkpoint_file(moving))
    write_checkpoint_file(moving, {**content, "progress": "half"})
    with pytest.raises(DevrfError, match="its parts do not fit together"):
        unfinished(SimpleNamespace(checkpoint=lambda: moving))


def test_frames_of_other_times_do_not_fit(moving):
    clock = ("state_dict", "scene_model.deformation._extra_state", "times")
    write_checkpoint_file(moving, changed(read_checkpoint_file(moving), clock, [0.0]))
    with pytest.raises(DevrfError, match="do not fit together .*: frames of other times"):
        load_checkpoint(moving)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["canonical", "deformation"])
def test_a_progress_file_goes_on_or_is_refused(rest, datamodule, trainer, tmp_path, name):
    def stage() -> Stage:
        if name == "deformation":
            levels = (Level(4, 4),)
            schedule = DeformationSchedule(levels=levels, rays=64)
            return DeformationStage(rest, schedule, iterations_per_step=1)
        sizes = {"search_iterations": 0, "search_side": 8, "iterations": 3, "side": 10}
        schedule = CanonicalSchedule(**sizes, upsample_at=(1,), rays=64)
        return CanonicalStage(schedule, iterations_per_step=1)

    def learn(progress: Path | None, *further: Callback) -> None:
        watching = (TrainingRecord(), Previews(), DivergenceGuard(), *further)
        learner = trainer(*watching, max_epochs=1)
        fit(learner, stage(), datamodule, progress)

    def leave(learner: Trainer, learns: Stage, *_: Any) -> None:
        learner.save_checkpoint(path)
        learner.should_stop = True

    path = tmp_path / "progress.ckpt"
    learn(None, LambdaCallback(on_train_batch_end=leave))
    parts = ("progress", "optimizer_states", "loops", "callbacks", "state_dict")
    count = INPUTS // 8
    assert try_all(path, parts, lambda: learn(path), count) > count // 4
