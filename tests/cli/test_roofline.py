"""The least work of an iteration, counted by hand."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from lightning import Trainer

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.cli.roofline import Work, decoder_operations, roofline
from devrf.data.datamodule import SceneDataModule
from devrf.geometry.box import Box
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.schedules import CanonicalSchedule, DeformationSchedule
from devrf.methods.devrf.settings import DEFORMATION_LOSS

COUNTS = {"tested": 1000.0, "opaque": 400.0, "reached": 300.0, "heavy": 100.0}
# Four features, two hidden layers of 16, directions in 3 + 2 · 6 numbers.
BY_SAMPLE, BY_RAY = 2 * 16 * (4 + 16 + 3), 2 * 16 * 15


def test_bytes_and_operations_take_their_time_one_after_the_other() -> None:
    assert Work(6e9, 4e12).seconds(2e9, 8e12) == pytest.approx(3.5)


def test_the_network_of_the_paper(cube: Box) -> None:
    field = Architecture().radiance_field(cube, 8, 8)
    # 12 → 128 → 128 → 3, and 27 numbers of a direction.
    assert decoder_operations(field, 10, 1000) == 2 * (128 * (12 + 128 + 3) * 1000 + 128 * 27 * 10)
    assert decoder_operations(Architecture().search_field(cube, 8), 10, 1000) == 0


@pytest.mark.parametrize(("cycle", "flow"), [(True, True), (False, False)])
def test_the_deformation_stage(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    cycle: bool,
    flow: bool,
) -> None:
    schedule = DeformationSchedule(sides=(6,), iterations_per_frame=(2,), rays=64)
    loss = {**DEFORMATION_LOSS, "cycle": 100.0 * cycle, "flow": 0.005 * flow}
    stage = DeformationStage(rest, schedule, loss=loss)
    trainer(max_steps=1).fit(stage, datamodule=datamodule)
    x, y, z = stage.resolution
    expected = 1000 * (32 + 96) + 300 * 2 * 96 + 100 * 4 * 32 + 2 * 3 * x * y * z * 28
    expected += 100 * 3 * 96 * cycle + 100 * 96 * flow
    assert roofline(stage, COUNTS) == Work(expected, 2 * (BY_SAMPLE * 100 + BY_RAY * 64))


def test_frames_that_are_visited_together_are_stepped_on_together(
    rest: LoadedCheckpoint, four_frames: SceneDataModule, trainer: Callable[..., Trainer]
) -> None:
    schedule = DeformationSchedule(
        sides=(6,), iterations_per_frame=(1,), rays=64, coarse_to_fine=False, parallel_frames=(2,)
    )
    stage = DeformationStage(rest, schedule, loss={"render": 1.0})
    trainer(max_steps=2).fit(stage, datamodule=four_frames)
    x, y, z = stage.resolution
    expected = 1000 * (32 + 96) + 300 * 2 * 96 + 100 * 4 * 32 + 2 * 2 * 3 * x * y * z * 28
    assert roofline(stage, COUNTS) == Work(expected, 2 * (BY_SAMPLE * 100 + BY_RAY * 2 * 64))


@pytest.mark.parametrize("searching", [True, False])
def test_the_canonical_stage(
    datamodule: SceneDataModule, trainer: Callable[..., Trainer], searching: bool
) -> None:
    schedule = CanonicalSchedule(
        search_iterations=9 if searching else 0,
        search_side=12,
        carve=True,
        iterations=9,
        side=14,
        doublings=(),
        rays=64,
    )
    stage = CanonicalStage(schedule, Architecture(channels=4, width=16, frequencies=2))
    trainer(max_steps=1).fit(stage, datamodule=datamodule)
    work, voxels = roofline(stage, COUNTS), stage.model.canonical.density.values.numel()
    assert work is not None and voxels > 4 * 300
    looked_up, channels = 1000 * 32 + 300 * 2 * 32, 3 if searching else 4
    looked_up += 100 * channels * 3 * 32
    stepped = voxels * 4 if searching else 4 * 300 + 4 * 100 * 4
    assert work.bytes == looked_up + 28 * stepped
    assert work.operations == (0 if searching else 3 * (BY_SAMPLE * 100 + BY_RAY * 64))
    # What nobody has counted is not made up.
    assert roofline(stage, {"reached": 1.0, "heavy": 1.0}) is None


def test_no_more_values_are_stepped_on_than_there_are(
    datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> None:
    schedule = CanonicalSchedule(
        search_iterations=0, search_side=8, carve=True, iterations=9, side=6, doublings=(), rays=64
    )
    stage = CanonicalStage(schedule, Architecture(channels=4, width=16, frequencies=2))
    trainer(max_steps=1).fit(stage, datamodule=datamodule)
    voxels = stage.model.canonical.density.values.numel()
    work = roofline(stage, {"tested": 0.0, "reached": 1e6, "heavy": 1e6})
    assert work is not None
    looked_up = 1e6 * 2 * 32 + 1e6 * 4 * 3 * 32
    assert work.bytes == pytest.approx(looked_up + 28 * 5 * voxels)
