"""What a field leaves empty is skipped, and what comes back is found again."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.dnerf.model import DNeRF, DNeRFSettings
from devrf.methods.nerf.occupancy import DECAY, EVERY, LEAST, LearnedOccupancy, OccupancyFrames
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.settings import NSFFSettings
from devrf.scenes.scene import Scene

FIRST = torch.zeros(1, dtype=torch.int64)


def on_the_left(points: Tensor, time: Tensor) -> Tensor:
    """Half opaque where x < 0, at all times."""
    return torch.where(points[:, 0] < 0, 0.5, 0.0)


def looked(steps: int, opacity_at: object, cube: Box) -> LearnedOccupancy:
    """5 × 3 × 3 cells (x = −1, −½, 0, ½, 1), looked at through ``steps`` iterations."""
    cells = LearnedOccupancy((5, 3, 3))
    for step in range(steps):
        cells.follow(step, steps, 0.0, cube, opacity_at)  # type: ignore[arg-type]
    return cells


def test_cells_are_occupied_where_the_field_is(cube: Box) -> None:
    cells = looked(1, on_the_left, cube)
    torch.testing.assert_close(cells.opacity[:2], torch.full((2, 3, 3), 0.5))
    assert (cells.opacity[3:] == 0).all()
    assert looked(0, on_the_left, cube).occupied(torch.arange(45)).all()  # type: ignore[union-attr]


def test_all_processes_look_at_the_same_places_and_times(cube: Box) -> None:
    def anywhere(points: Tensor, time: Tensor) -> Tensor:
        return (points.sum(dim=1) + time).sin().abs()

    # Each has drawn other numbers, and other numbers of them.
    torch.manual_seed(1)
    first = looked(3 * EVERY, anywhere, cube)
    torch.manual_seed(2)
    assert torch.equal(looked(3 * EVERY, anywhere, cube).opacity, first.opacity)


def test_nothing_is_left_out_before_the_start(cube: Box) -> None:
    cells = LearnedOccupancy((5, 3, 3))
    # At 0 another stage begins anew.
    for step, empty in ((0, False), (EVERY - 1, False), (EVERY, True), (0, False)):
        cells.follow(step, 2 * EVERY, 0.5, cube, on_the_left)
        assert bool((cells.opacity[3:] == 0).all()) is empty
        assert empty or bool((cells.opacity == 1).all())


def test_what_is_there_for_a_fifth_of_the_time_stays(cube: Box) -> None:
    def passing(points: Tensor, time: Tensor) -> Tensor:
        return torch.where(time < 0.2, 0.9, 0.0)

    assert (looked(60 * EVERY, passing, cube).opacity > LEAST).all()


def test_what_has_gone_is_forgotten_and_found_when_it_comes_back(cube: Box) -> None:
    cells, step = looked(1, on_the_left, cube), 0
    looks = math.ceil(math.log(LEAST / 0.5) / math.log(DECAY))
    # Each looks at half of the cells.
    for there, count in (
        (lambda points, time: torch.zeros_like(time), 4 * looks),
        (on_the_left, 20),
    ):
        for _ in range(count):
            step += EVERY
            cells.follow(step, 1, 0.0, cube, there)
        assert bool((cells.opacity[:2] > LEAST).all()) is (there is on_the_left)
        assert not (cells.opacity[3:] > LEAST).any()


def test_a_field_that_has_diverged_leaves_nothing_out(cube: Box) -> None:
    cells = looked(1, lambda points, time: torch.full_like(time, math.nan), cube)
    assert cells.occupied(torch.arange(45)).all()  # type: ignore[union-attr]


def test_rays_skip_what_is_empty_but_for_their_last_sample(cube: Box) -> None:
    occupancy = OccupancyFrames(1, (5, 3, 3))
    occupancy.learned = looked(1, on_the_left, cube)
    x = torch.tensor([[1.0, 0.0, 0.0]])
    rays = Rays(torch.tensor([[-3.0, 0.0, 0.0]]), x, x)
    samples = occupancy.march(rays, (FIRST, FIRST), cube, (0.0, 9.0), 0.25, jitter=False)
    # Half of the cell around 0 is on the left; the last of all lies half a step behind the box.
    assert samples.points[:, 0].tolist() == [-0.875, -0.625, -0.375, -0.125, 0.125, 1.125]


TINY = DNeRFSettings(
    width=8, depth=2, bands=2, direction_bands=1, deformation_width=8, deformation_depth=2,
    time_bands=2, sampling="occupancy", steps=16, occupancy_side=8, empty_from=0.0,
)  # fmt: skip


def test_mattes_leave_nothing_to_learn(tiny_scene: Scene) -> None:
    model = DNeRF(TINY)
    model.setup(tiny_scene)
    assert not model.occupancy.learned.opacity.numel()
    model = DNeRF(replace(TINY, hull=False))
    model.setup(tiny_scene)
    assert model.occupancy.learned.opacity.shape == model.occupancy.mask.shape[1:]
    model.on_iteration(0, 4)
    assert (model.occupancy.learned.opacity < 1).any()
    never = DNeRF(replace(TINY, hull=False, empty_from=None))
    never.setup(tiny_scene)
    assert never.occupancy.learned.occupied(FIRST) is None
    again = DNeRF.from_config(model.config())
    again.load_stored_state(model.stored_state())
    assert torch.equal(again.occupancy.learned.opacity, model.occupancy.learned.opacity)


def test_opacity_is_that_of_a_sample(tiny_scene: Scene) -> None:
    model = DNeRF(replace(TINY, hull=False))
    model.setup(tiny_scene)
    x = torch.tensor([[1.0, 0.0, 0.0]])
    middle = torch.tensor([model.box.middle])
    rays = Rays(middle - sum(model.depth_limits) / 2 * x, x, x)
    seen = model.eval().render_rays(rays, torch.tensor([0.5]), torch.ones(3))
    first = model.placement.fields(seen.extras["points"][:1])
    opacity = model.opacity(first, torch.tensor([0.5]))
    # Nothing is in front of the first sample of a ray: its weight is its opacity.
    torch.testing.assert_close(opacity, seen.extras["weight"][:1])


def test_the_denser_of_two_fields_counts(tiny_scene: Scene) -> None:
    model = NSFF(
        NSFFSettings(
            width=8, depth=2, bands=2, direction_bands=1, sampling="occupancy", steps=16,
            occupancy_side=8, hull=False,
        )
    )  # fmt: skip
    model.setup(tiny_scene)
    points, time = torch.tensor([model.box.middle] * 2), torch.tensor([0.0, 1.0])
    found = []
    for still, moving in ((3.0, -3.0), (-3.0, 3.0), (-30.0, -30.0)):
        for field, bias in ((model.fields.static, still), (model.fields.dynamic, moving)):
            torch.nn.init.zeros_(field.density.weight)
            torch.nn.init.constant_(field.density.bias, bias)
        found.append(model.opacity(points, time))
    step = model.box.diagonal / 16 / model.placement.half_edge
    depth = 10 * math.log1p(math.exp(3.0)) * step
    torch.testing.assert_close(found[0], torch.full((2,), 1 - math.exp(-depth)))
    assert torch.equal(found[0], found[1]) and (found[2] < 1e-6).all()
