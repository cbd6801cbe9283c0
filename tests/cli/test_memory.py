"""The estimate of memory and disk, by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from devrf.cli.memory import (
    APPEARANCE,
    FRAMES,
    GRIDS,
    IMAGES,
    PARALLEL,
    PROGRAM,
    Budget,
    StageNeeds,
    estimate,
    module_needs,
    samples_per_ray,
    tensor_bytes,
)
from devrf.geometry.box import Box
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.extensions.color_residual import AppearanceSettings
from devrf.methods.devrf.extensions.refinement import RefinementSettings
from devrf.methods.devrf.settings import MotionSettings
from devrf.scenes.scene import Scene

SMALL = Architecture(channels=4, width=16, frequencies=2)
CANONICAL = CanonicalSchedule(
    search_iterations=0, search_side=8, iterations=10, side=10, upsample_at=(5,), rays=64
)
DEFORMATION = DeformationSchedule(levels=(Level(4, 2), Level(8, 2)), rays=64)
POINTS, GRID_BYTES = 10**3, 10**3 * (1 + 4) * 4
# 4→16 with bias, direction (3 + 6·2)→16, 16→16 and 16→3 with bias.
DECODER = 4 * (4 * 16 + 16 + 15 * 16 + 16 * 16 + 16 + 3 * 16 + 3)
# Both directions of one frame on 8³ points.
SLICES = 2 * 8**3 * 12


@pytest.fixture
def cubic(four_frame_scene: Scene, cube: Box) -> Scene:
    """24×18 px; 8 static views, 2 moving views × 4 frames; in a cube."""
    return replace(four_frame_scene, bounds=replace(four_frame_scene.bounds, box=cube, motion=None))


def stage(**changes: object) -> StageNeeds:
    """A stage of round numbers."""
    return replace(StageNeeds(50, {GRIDS: 100}, 800, "rays", 200, 40, 30, 70), **changes)  # type: ignore[arg-type]


def deformation_needs(scene: Scene, schedule: Any = DEFORMATION, **motion: Any) -> StageNeeds:
    budget = estimate(scene, CANONICAL, schedule, SMALL, motion=MotionSettings(**motion))
    return budget.stages["deformation"]


def test_the_canonical_stage_by_hand(cubic: Scene) -> None:
    needs = estimate(cubic, CANONICAL, DEFORMATION, SMALL).stages["canonical"]
    field = GRID_BYTES + DECODER
    # Values, gradients, two moments, a copy; occupancy.
    assert needs.held == {GRIDS: 5 * field + 2 * POINTS, IMAGES: 8 * 24 * 18 * 8}
    assert needs.views == tensor_bytes(cubic.static.train)
    assert needs.learned == field + POINTS
    assert needs.checkpoint == GRID_BYTES // 2 + DECODER + POINTS
    assert needs.progress == 3 * field + 5 * POINTS


def test_the_deformation_stage_by_hand(cubic: Scene) -> None:
    needs = deformation_needs(cubic)
    field = GRID_BYTES + DECODER + POINTS
    active = 11 * SLICES // 2
    assert needs.held[FRAMES] == 4 * SLICES + active
    assert needs.held[GRIDS] == field + 3 * POINTS
    assert needs.held[IMAGES] == 2 * 24 * 18 * 8
    assert needs.learned == field + 4 * SLICES
    assert needs.checkpoint == GRID_BYTES // 2 + DECODER + POINTS + 2 * SLICES
    assert needs.progress == field + 4 * SLICES + 2 * SLICES
    assert deformation_needs(cubic, store_half=True).held[FRAMES] == 2 * SLICES + active
    # With the next frame, which is being copied.
    assert deformation_needs(cubic, store="host").held[FRAMES] == active + SLICES


def test_each_parallel_frame_counts(cubic: Scene) -> None:
    one = deformation_needs(cubic)
    two = deformation_needs(
        cubic, replace(DEFORMATION, levels=(Level(4, 2), Level(8, 2, parallel_frames=2)))
    )
    assert two.held[FRAMES] == 4 * SLICES and two.held[PARALLEL] == 11 * SLICES
    assert two.held[IMAGES] == 2 * one.held[IMAGES]
    assert (two.batch, two.batches) == (2 * one.batch, 2)
    assert two.progress - one.progress == 2 * SLICES


def test_the_level_that_needs_most_counts(cubic: Scene) -> None:
    # Two frames on nearly as many voxels, or one on all; files are of the last level.
    schedule = DeformationSchedule(
        levels=(Level(4, 1), Level(22, 1, parallel_frames=2), Level(24, 1)), rays=64
    )
    needs = deformation_needs(cubic, schedule)
    assert needs.held[PARALLEL] == 2 * 11 * 22**3 * 12
    assert needs.learned == GRID_BYTES + DECODER + POINTS + 4 * 2 * 24**3 * 12


def test_any_module_that_adam_trains(cubic: Scene) -> None:
    with torch.device("meta"):
        network = nn.Sequential(nn.Linear(10, 5), nn.BatchNorm1d(5))
    views = cubic.static.train
    needs = module_needs(network, views, keys=("method.width",), batch=1000, rays="method.rays")
    parameters, buffers = 4 * (10 * 5 + 5 + 5 + 5), 4 * (5 + 5) + 8
    assert needs.held == {("method.width",): 5 * parameters + buffers, IMAGES: 8 * 24 * 18 * 8}
    assert (needs.learned, needs.progress) == (parameters + buffers, 3 * parameters + buffers)
    assert needs.batch == 1000


def test_a_peak_is_what_is_held_and_the_largest_of_what_passes() -> None:
    assert stage().peak() == 50 + 100 + 800
    assert stage().peak(8) == 50 + 100 + 200  # 800 / 8 is less than what else passes
    # A CPU takes one of four batches at a time, and has the views anyway.
    assert stage(batches=4, temporary=0).on_host == round(1.3 * (100 + 200))


def test_a_host_needs_program_scene_and_stage() -> None:
    budget = Budget(1000, {"one": stage(), "other": stage(learned=90, checkpoint=60)})
    beside_a_gpu = PROGRAM + 1000 + 150
    assert budget.host(alone=False) == beside_a_gpu
    assert budget.host(alone=False, processes=2) == 2 * beside_a_gpu
    assert budget.host(alone=True) == PROGRAM + 1000 + round(1.3 * 900)
    assert budget.rows() == [
        ("GPU, one stage", 950),
        ("GPU, other stage", 950),
        ("host, beside a GPU", beside_a_gpu),
        ("host, without a GPU", PROGRAM + 2170),
        ("checkpoint", 60),
    ]


def test_a_disk_needs_what_is_there_at_once() -> None:
    first, second = stage(checkpoint=400, progress=1200), stage(checkpoint=1400, progress=1500)
    both = Budget(0, {"one": first, "other": second})
    # Three progress files of the second stage beside the first one's checkpoint.
    assert both.disk(kept=2) == 400 + 3 * 1500
    assert Budget(0, {"one": first}).disk(kept=2) == 3 * 1200
    assert both.disk(kept=2, films=9000) == 400 + 1400 + 9000
    assert Budget(0, {"one": stage(checkpoint=9, progress=8)}).disk(kept=2) == 2 * 8 + 9


def test_tensors_of_views_by_hand(tiny_scene: Scene) -> None:
    moving = tiny_scene.dynamic.train
    pixels = len(moving) * 24 * 18
    assert moving.flow is not None
    assert tensor_bytes(moving.flow) == (2 * 4 + 1) * pixels
    deep = replace(moving, depth=torch.zeros(len(moving), 18, 24))
    assert tensor_bytes(deep) - tensor_bytes(replace(moving, depth=None)) == 4 * pixels


def test_samples_of_a_ray(cube: Box) -> None:
    # The mean chord of a cube is 2/3 of its edge: of 30 voxels 20, sampled twice each.
    with torch.device("meta"):
        field = Architecture().radiance_field(cube, 30**3, 30**3)
        planes = Architecture(planes=128).radiance_field(cube, 30**3, 30**3)
    assert samples_per_ray(field, 30**3, 0.5) == pytest.approx(40)
    assert samples_per_ray(planes, 30**3, 0.5) == 255


def test_the_papers_sizes(cubic: Scene) -> None:
    moving = cubic.dynamic.train[torch.zeros(50, dtype=torch.long)]
    dynamic = replace(cubic.dynamic, train=replace(moving, times=torch.linspace(0, 1, 50)))
    budget = estimate(
        replace(cubic, dynamic=dynamic), CanonicalSchedule(), DeformationSchedule(), Architecture()
    )
    for needs in budget.stages.values():
        assert 1e9 < needs.peak() < 12e9
    assert budget.stages["deformation"].learned > 2 * 2.4576e9


def test_colours_that_change_by_hand(cubic: Scene) -> None:
    plain, settings = deformation_needs(cubic), AppearanceSettings(learn="always", side=6)
    needs = estimate(cubic, CANONICAL, DEFORMATION, SMALL, appearance=settings).stages[
        "deformation"
    ]
    frame = 6**3 * 12
    # Four frames; the active one's values, gradients, two moments, a copy.
    assert needs.held == {**plain.held, APPEARANCE: 9 * frame}
    assert needs.learned - plain.learned == 4 * frame
    assert needs.checkpoint - plain.checkpoint == 2 * frame
    assert needs.progress - plain.progress == 6 * frame
    never = replace(settings, learn="never")
    assert (
        estimate(cubic, CANONICAL, DEFORMATION, SMALL, appearance=never).stages["deformation"]
        == plain
    )


def test_the_refinement_by_hand(cubic: Scene) -> None:
    plain, settings = deformation_needs(cubic), RefinementSettings(iterations=1)
    needs = estimate(cubic, CANONICAL, DEFORMATION, SMALL, refinement=settings).stages[
        "deformation"
    ]
    # Gradients, two moments, a copy; masks and vicinities of four frames.
    assert needs.held[GRIDS] - plain.held[GRIDS] == 4 * (GRID_BYTES + DECODER) + 8 * POINTS
    # The pixels of all images at once.
    assert needs.held[IMAGES] - plain.held[IMAGES] == 8 * 24 * 18 * 8
