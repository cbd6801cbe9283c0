"""What a run will need, counted by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from devrf.methods.devrf.schedules import CanonicalSchedule, DeformationSchedule

from devrf.cli.memory import (
    BATCH,
    PROGRAM,
    StageFiles,
    StageMemory,
    batch_bytes,
    estimate,
    samples_per_ray,
    view_bytes,
)
from devrf.geometry.box import Box
from devrf.methods.devrf.architecture import Architecture
from devrf.scenes.scene import Scene

SMALL = Architecture(channels=4, width=16, frequencies=2)
CANONICAL = CanonicalSchedule(
    search_iterations=0, search_side=8, iterations=10, side=10, doublings=(5,), rays=64
)
DEFORMATION = DeformationSchedule(sides=(4, 8), iterations_per_frame=(2, 2), rays=64)


@pytest.fixture
def cubic(tiny_scene: Scene, cube: Box) -> Scene:
    """The tiny scene (24×18 px; 8 static views, 2 views × 3 frames) in a cube."""
    return replace(tiny_scene, bounds=replace(tiny_scene.bounds, box=cube, motion=None))


def test_fields_gradients_and_moments_by_hand(cubic: Scene) -> None:
    budget = estimate(cubic, CANONICAL, DEFORMATION, SMALL)
    grids = 10**3 * (1 + 4) * 4
    # 4→16 with bias, direction (3 + 6·2)→16, 16→16 and 16→3 with bias.
    decoder = 4 * (4 * 16 + 16 + 15 * 16 + 16 * 16 + 16 + 3 * 16 + 3)
    canonical = budget.canonical.held
    assert canonical["density and features"] == grids == canonical["their gradients"]
    assert canonical["their Adam moments"] == 2 * grids
    assert canonical["decoder, with gradients and moments"] == 4 * decoder
    assert canonical["occupancy"] == 2 * 10**3
    assert canonical["pixels to draw from"] == 8 * 24 * 18 * 8
    moving = budget.deformation.held
    displacements = 2 * 3 * 8**3 * 3 * 4  # both ways, 3 frames
    assert moving["displacements of 3 frames, both ways"] == displacements
    assert moving["gradients of one frame"] == displacements // 3
    assert moving["Adam moments of one frame"] == 2 * displacements // 3
    assert moving["pixels to draw from"] == 2 * 24 * 18 * 8
    # The old grids of one direction.
    grown = 3 * 4**3 * 12
    assert budget.deformation.passing["growing the grids"] == grown
    assert sum(budget.fields.values()) == grids + decoder + 10**3 + displacements
    # Grids in half precision.
    small = grids // 2 + decoder + 10**3
    assert sum(budget.checkpoint.values()) == small + displacements // 2
    assert budget.files["canonical"].finished == small
    assert budget.files["deformation"].progress == (
        grids + decoder + 10**3 + displacements + 2 * displacements // 3
    )


def test_images_flow_and_depth_by_hand(tiny_scene: Scene) -> None:
    moving = tiny_scene.dynamic.train
    assert len(moving) == 6 and moving.flow is not None
    parts = view_bytes(replace(moving, depth=torch.zeros(6, 18, 24)))
    pixels = 6 * 24 * 18
    channels = moving.pixels.shape[3]
    assert parts == {
        "images": channels * pixels,
        "optical flow": (2 * 4 + 1) * pixels,
        "depth": 4 * pixels,
    }
    assert set(view_bytes(replace(moving, flow=None, depth=None))) == {"images"}
    masked = replace(moving, valid_mask=torch.ones(6, 18, 24, dtype=torch.bool))
    assert view_bytes(masked)["masks"] == pixels


def test_the_host_holds_all_views_the_fields_and_their_checkpoint(cubic: Scene) -> None:
    budget = estimate(cubic, CANONICAL, DEFORMATION, SMALL)
    everything = [v for c in (cubic.static, cubic.dynamic) for v in (c.train, c.test)]
    assert budget.scene["images"] == sum(v.pixels.numel() for v in everything)
    scene = sum(budget.scene.values())
    learned = sum(budget.fields.values()) + sum(budget.checkpoint.values())
    assert budget.host == PROGRAM + scene + learned
    assert budget.host_alone >= budget.host


def test_a_copy_to_go_back_to_counts(cubic: Scene) -> None:
    budget = estimate(cubic, CANONICAL, DEFORMATION, SMALL)
    fields = budget.canonical.held["density and features"] + budget.deformation.held["decoder"]
    assert budget.canonical.held["a copy to go back to"] == fields
    slices = budget.deformation.held["gradients of one frame"]
    assert budget.deformation.held["a copy of one frame to go back to"] == slices


@pytest.fixture
def four_cubic(four_frame_scene: Scene, cube: Box) -> Scene:
    """The same in four frames."""
    bounds = replace(four_frame_scene.bounds, box=cube, motion=None)
    return replace(four_frame_scene, bounds=bounds)


def test_frames_that_are_learned_together_count_each(four_cubic: Scene) -> None:
    alone = estimate(four_cubic, CANONICAL, DEFORMATION, SMALL)
    both = estimate(four_cubic, CANONICAL, replace(DEFORMATION, parallel_frames=(1, 2)), SMALL)
    one, two = alone.deformation, both.deformation
    for part in ("{}", "gradients of {}", "Adam moments of {}", "a copy of {} to go back to"):
        name = part.format("2 frames side by side")
        assert two.held[name] == 2 * one.held[part.format("one frame")]
    assert two.held["pixels to draw from"] == 2 * one.held["pixels to draw from"]
    assert two.held["occupancy"] - one.held["occupancy"] == 10**3
    assert two.passing[BATCH] == 2 * one.passing[BATCH]
    # The place beside each of both, and what each needs in its turn.
    slices = one.held["gradients of one frame"]
    assert two.passing["an optimiser step"] == 3 * slices
    moments = both.files["deformation"].progress - alone.files["deformation"].progress
    assert moments == 2 * slices


def test_the_level_that_needs_most_counts(four_cubic: Scene) -> None:
    # Both frames on nearly as many voxels, or one on all.
    schedule = DeformationSchedule(
        sides=(4, 22, 24), iterations_per_frame=(1, 1, 1), rays=64, parallel_frames=(1, 2, 1)
    )
    held = estimate(four_cubic, CANONICAL, schedule, SMALL).deformation.held
    assert held["gradients of 2 frames side by side"] == 2 * 2 * 22**3 * 12
    assert held["displacements of 4 frames, both ways"] == 2 * 4 * 22**3 * 12


def test_a_cpu_has_one_batch_at_a_time() -> None:
    together = StageMemory({"a": 100}, {BATCH: 800, "b": 200}, batches=4)
    assert (together.peak, together.least, together.on_host) == (900, 300, 390)


def test_in_hard_times_a_batch_is_taken_in_eight_parts() -> None:
    assert StageMemory({"a": 3}, {BATCH: 80, "b": 4}).least == 13
    assert StageMemory({"a": 3}, {BATCH: 80, "b": 40}).least == 43


def test_on_the_host_the_images_are_there_anyway() -> None:
    assert StageMemory({"a": 100, "images": 50, "depth": 7}, {"c": 100}).on_host == 260


def test_the_files_of_a_stage() -> None:
    # Two that are kept, and the next beside them; or the finished one.
    assert StageFiles(finished=5, progress=8).peak(kept=2) == 24
    assert StageFiles(finished=9, progress=8).peak(kept=2) == 25


def test_a_peak_is_what_is_held_and_the_largest_of_what_passes() -> None:
    assert StageMemory({"a": 3, "b": 4}, {"c": 10, "d": 2}).peak == 17
    assert StageMemory({"a": 3}, {}).peak == 3


def test_the_fields_of_a_learned_scene(tiny_scene: Scene, rest) -> None:
    # As the fixture was learned: side 20; the box that it found is another than the bounds'.
    schedule = CanonicalSchedule(search_iterations=0, iterations=120, side=20, doublings=(40,))
    parts = estimate(tiny_scene, schedule, DEFORMATION, SMALL).fields
    said = sum(size for name, size in parts.items() if "frames" not in name)
    kept = [v for v in rest.model.state_dict().values() if isinstance(v, torch.Tensor)]
    assert said == pytest.approx(sum(v.numel() * v.element_size() for v in kept), rel=0.1)


def test_samples_of_a_ray(cube: Box) -> None:
    # The mean chord of a cube is 2/3 of its edge: of 30 voxels 20, sampled twice each.
    assert samples_per_ray(cube, 30**3, None, 0.5) == pytest.approx(40)
    assert samples_per_ray(cube, 30**3, 128, 0.5) == 255


def test_fog_costs_most(cube: Box) -> None:
    schedule = CanonicalSchedule()
    sizes = [batch_bytes(schedule, k, Architecture(), cube, 0.5) for k in range(6)]
    # The first fine phase decodes every sample of its fog; later ones a tenth of them.
    assert sizes[1] > 4 * sizes[2] > 0
    assert sizes[2] < sizes[3] < sizes[4] < sizes[5]
    assert sizes[0] > 0


def test_the_papers_sizes(cubic: Scene) -> None:
    """50 × 160³ displacements of 12 bytes each way: 2.46 GB per direction (method §3)."""
    times = torch.linspace(0, 1, 50)
    moving = cubic.dynamic.train[torch.zeros(50, dtype=torch.long)]
    dynamic = replace(cubic.dynamic, train=replace(moving, times=times))
    budget = estimate(
        replace(cubic, dynamic=dynamic), CanonicalSchedule(), DeformationSchedule(), Architecture()
    )
    both = budget.fields["displacements of 50 frames, both ways"]
    assert both == pytest.approx(2 * 2.46e9, rel=0.01)
    assert 5e9 < budget.gpu < 12e9
    assert math.isfinite(budget.host)


def test_nothing_is_drawn_at_random(cubic: Scene) -> None:
    before = torch.get_rng_state()
    estimate(cubic, CANONICAL, DEFORMATION, SMALL)
    assert torch.equal(before, torch.get_rng_state())
