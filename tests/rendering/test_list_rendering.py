"""Lists of fixed length: they learn what exact lists do, and show what the renderer shows."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_field import CanonicalField, look_up
from devrf.methods.devrf.deformation_field import GridWarp
from devrf.methods.devrf.volume_rendering import render
from devrf.ops.dispatch import using
from devrf.rendering import front_to_back
from devrf.rendering import list_rendering as module
from devrf.rendering.list_rendering import ListRenderer, render_static
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.renderer import Renderer
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.rendering.sampling import RenderSettings, most_steps, steps_through

RAYS = 24
SETTINGS = RenderSettings(step=0.5, alpha_threshold=0.02, near=0.2, far=9.0)
WHITE = torch.ones(3)


class World:
    """A random field in a box, partly occupied, that is seen through a warp."""

    def __init__(self, dtype, frames, planes=None):
        rng = torch.Generator().manual_seed(2)

        def draw(*shape):
            return 2 * torch.rand(*shape, generator=rng, dtype=torch.float64) - 1

        box = Box((-1.0, -0.9, -0.8), (0.9, 1.0, 0.7))
        sizes = Architecture(channels=4, width=8, frequencies=1, alpha_init=0.1, planes=planes)
        self.field = sizes.radiance_field(box, 7**3, 9**3).to(dtype)
        with torch.no_grad():
            values = self.field.density.values
            values.copy_(4 * draw(*values.shape))
            self.field.color.values.copy_(draw(*self.field.color.values.shape))
        self.occupancy = Occupancy(draw(6, 7, 5) > -0.4, box)
        self.slices = tuple(
            (0.1 * draw(4, 3, 5, 3)).to(dtype).requires_grad_() for _ in range(frames)
        )
        self.warp = GridWarp(self.slices, box, 0.3 if frames == 2 else 0.0)
        # Colours change while something moves.
        self.residual = (draw(3, 4, 3, 3)).to(dtype).requires_grad_() if frames else None
        self.color_change = (
            None if self.residual is None else partial(look_up, self.residual, box=box)
        )
        origins = torch.tensor([[-3.0, 0.0, 0.0]]) + 0.3 * draw(RAYS, 3)
        directions = torch.nn.functional.normalize(
            torch.tensor([[1.0, 0.0, 0.0]]) + 0.25 * draw(RAYS, 3), dim=1
        )
        self.rays = Rays(origins.to(dtype), directions.to(dtype), directions.to(dtype))
        self.behind = draw(RAYS, 3).abs().to(dtype)

    @property
    def leaves(self):
        residuals = [] if self.residual is None else [self.residual]
        return [*self.field.parameters(), *self.slices, *residuals]

    def exactly(self):
        return render(
            self.rays,
            self.field,
            self.occupancy,
            SETTINGS,
            self.behind,
            self.warp,
            color_change=self.color_change,
        )

    def listed(self, capacity):
        return render_static(
            self.rays,
            self.field,
            self.occupancy,
            SETTINGS,
            self.behind,
            self.slices,
            self.warp.weight,
            capacity,
            color_change=self.color_change,
        )


def ample():
    return SampleCapacity(RAYS, torch.device("cpu"))


def fitting():
    """Just enough: the interpreter takes its time over padding, too."""
    capacity = ample()
    capacity.visible = capacity.significant = 240
    return capacity


def learn(output, leaves):
    """Gradients of :func:`worth`."""
    return list(torch.autograd.grad(worth(output), leaves))


def worth(output):
    """Something that every part of the output has a share in."""
    tilt = torch.linspace(-1, 1, RAYS, dtype=output.color.dtype)
    by_sample = output.weight * (output.sample_color.sum(1) + output.canonical.sum(1).square())
    return (output.color.sum(1) * tilt + output.transmittance * tilt).sum() + by_sample.sum()


def kept(output):
    present = output.samples.present
    return slice(None) if present is None else present.nonzero()[:, 0]


def test_front_to_back_sees_the_same_and_looks_no_further_than_it_has_to(monkeypatch):
    world, asked = World(torch.float64, 1), []
    with torch.no_grad():
        expected = world.exactly()
        world.field.density.values += 6.0  # most rays end early
        opaque = world.exactly()
    monkeypatch.setattr(front_to_back, "SLAB", 1)

    def warp(points):
        asked.append(len(points))
        return world.warp(points)

    scene = world.rays, world.field, world.occupancy, SETTINGS, world.behind, warp
    seen = front_to_back.picture(*scene, world.color_change)
    torch.testing.assert_close(seen.color, opaque.color)
    torch.testing.assert_close(seen.depth, opaque.depth)
    torch.testing.assert_close(1 - seen.opacity, opaque.transmittance)
    all_looked_at = sum(asked)
    asked.clear()
    with torch.no_grad():
        world.field.density.values -= 6.0
    seen = front_to_back.picture(*scene, world.color_change)
    torch.testing.assert_close(seen.color, expected.color)
    assert all_looked_at < 0.7 * sum(asked)


# How many slices the warp has: at rest, at a frame, between two.
@pytest.mark.parametrize(("frames", "planes"), [(0, None), (1, 9), (2, None)])
def test_lists_of_fixed_length_see_and_learn_the_same(frames, planes):
    world = World(torch.float64, frames, planes)
    with using("torch"):
        exact, listed = world.exactly(), world.listed(ample())
    assert 50 < len(exact.samples) < len(listed.samples)
    chosen = kept(listed)
    close = {"atol": 1e-12, "rtol": 1e-10}
    for name in ("color", "depth", "transmittance"):
        torch.testing.assert_close(getattr(listed, name), getattr(exact, name), **close)
    for name in ("canonical", "weight", "sample_color"):
        torch.testing.assert_close(getattr(listed, name)[chosen], getattr(exact, name), **close)
    assert torch.equal(listed.samples.ray[chosen], exact.samples.ray)
    torch.testing.assert_close(listed.samples.points[chosen], exact.samples.points, **close)
    expected = learn(exact, world.leaves)
    for ours, theirs in zip(learn(listed, world.leaves), expected, strict=True):
        torch.testing.assert_close(ours, theirs, **close)


def test_the_kernels_see_and_learn_the_same_and_add_to_gradients_in_place():
    pytest.importorskip("triton")
    world = World(torch.float32, 2)
    with using("torch"):
        exact = world.exactly()
        expected = learn(exact, world.leaves)
    for leaf in world.leaves:
        leaf.grad = torch.ones_like(leaf)
    before = [leaf.grad for leaf in world.leaves]
    with using("triton"):
        listed = world.listed(fitting())
        worth(listed).backward()
    for name in ("color", "depth", "transmittance"):
        torch.testing.assert_close(getattr(listed, name), getattr(exact, name))
    for leaf, there, change in zip(world.leaves, before, expected, strict=True):
        assert leaf.grad is there
        torch.testing.assert_close(there, 1 + change, atol=1e-5, rtol=1e-4)


def test_padding_is_no_sample_and_the_capacity_is_told():
    world, capacity = World(torch.float64, 1), ample()
    with using("torch"):
        exact, listed = world.exactly(), world.listed(capacity)
    present = listed.samples.present
    assert present is not None and len(present) == capacity.significant
    assert int(present.sum()) == len(exact.samples)
    assert not listed.weight[~present].any()
    assert bool(torch.isfinite(listed.canonical).all() & torch.isfinite(listed.sample_color).all())
    assert int(listed.samples.ray.min()) >= 0 and int(listed.samples.ray.max()) < RAYS
    # The most that was needed, until it is measured.
    capacity.note(torch.tensor(3), torch.tensor(2))
    capacity.visible = capacity.significant = 4096
    assert capacity.measure()
    spare = SampleCapacity.SPARE * len(exact.samples)
    assert spare <= capacity.significant < spare + SampleCapacity.GRAIN


def test_lists_that_are_too_short_lose_the_last_rays_alone_and_grow(caplog):
    world, capacity = World(torch.float64, 1), ample()
    with using("torch"), caplog.at_level("INFO", logger="devrf"):
        exact = world.exactly()
        capacity.significant = half = len(exact.samples) // 2
        cut = world.listed(capacity)
        whole = exact.samples.ray[half - 1]
        torch.testing.assert_close(cut.color[:whole], exact.color[:whole])
        assert not torch.allclose(cut.color, exact.color)
        assert not capacity.poll() and capacity.poll()  # asked, then answered
        again = world.listed(capacity)
        torch.testing.assert_close(again.color, exact.color)
        assert torch.equal(cut.transmittance, exact.transmittance)
        capacity.visible = capacity.significant = half
        cut = world.listed(capacity)
        assert torch.equal(cut.color[0], exact.color[0])
        assert torch.equal(cut.color[-1], world.behind[-1])
    assert sum("lists grow" in line for line in caplog.messages) == 1


def test_no_ray_has_more_samples_than_is_said():
    field: CanonicalField = World(torch.float64, 0).field
    rng = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=rng), dim=1)
    low, high = field.box.corners(directions)
    rays = Rays(-3 * directions + (low + high) / 2, directions, directions)

    def longest(step):
        return most_steps(field.box, step=step, near=0.0, far=9.0)

    for step in (0.3, 0.01):
        _, count = steps_through(rays, field.box, step=step, near=0.0, far=9.0)
        assert 0.5 * longest(step) < int(count.max()) <= longest(step)
    through = Rays(low[None], (high - low)[None] / (high - low).norm(), directions[:1])
    _, count = steps_through(through, field.box, step=0.01, near=0.0, far=9.0)
    assert longest(0.01) - 2 <= int(count) <= longest(0.01)


@pytest.fixture
def searches(monkeypatch):
    """The capacity of each search for samples."""
    capacities: list[int] = []
    inner: Callable[..., object] = module.search

    def counted(*arguments, capacity, **named):
        capacities.append(capacity)
        return inner(*arguments, capacity=capacity, **named)

    monkeypatch.setattr(module, "search", counted)
    return capacities


@pytest.mark.parametrize("time", [0.0, 0.7])
def test_what_the_renderer_shows(moving, tiny_scene, time, same, reference):
    rays, view = tiny_scene.dynamic.test.cameras.image_rays(0), moving.at(time)
    renderer = ListRenderer(moving.canonical, moving.settings, half=True)  # not on a CPU
    colors = moving.color_change(time)
    seen = renderer.picture(rays, view.occupancy, view.displacement, WHITE, colors)
    same(seen, reference(moving, rays, time, WHITE))
    assert int((seen.opacity > 0.5).sum()) > 20


def test_lists_grow_once_and_stay(moving, tiny_scene, searches, same):
    rays = tiny_scene.dynamic.test.cameras.image_rays(0)
    renderer = ListRenderer(moving.canonical, moving.settings)
    first = renderer.picture(rays, moving.occupancy, None, WHITE)
    known = list(searches)
    assert known[0] < known[1] == known[2] and len(known) == 3  # then it knows what is coloured
    same(renderer.picture(rays, moving.occupancy, None, WHITE), first)
    assert searches == [*known, known[-1]]
    # Much too long ones are shortened for the next picture.
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(len(rays), 3)
    renderer.picture(Rays(50 + 0 * up, up, up), moving.occupancy, None, WHITE)
    same(renderer.picture(rays, moving.occupancy, None, WHITE), first)
    assert searches[len(known) + 1 :] == [known[-1], *known]
    few = rays[: len(rays) // 4]
    renderer.picture(few, moving.occupancy, None, WHITE)
    assert searches[-1] < known[-1]
    renderer.picture(few, moving.occupancy, None, WHITE)
    assert searches[-1] == searches[-2]


def test_rays_that_meet_nothing(moving):
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    rays = Rays(torch.tensor([[50.0, 0.0, 0.0]]).expand(3, 3), up, up)
    renderer = ListRenderer(moving.canonical, moving.settings)
    for some in (rays, rays[:0]):
        seen = renderer.picture(some, moving.occupancy, None, WHITE)
        assert torch.equal(seen.color, torch.ones(len(some), 3))
        assert not seen.depth.any() and not seen.opacity.any()


@pytest.mark.skipif(os.environ["TRITON_INTERPRET"] != "1", reason="needs Triton's interpreter")
def test_the_renderer_shows_the_same_with_triton(moving, tiny_scene, searches, same):
    pytest.importorskip("triton")
    renderer, cameras = Renderer(moving), tiny_scene.dynamic.test.cameras.resized(5, 4)
    with using("torch"):
        plain = renderer.view(cameras, 0, 0.7, 1.0)
    assert not searches
    with using("triton"):
        same(renderer.view(cameras, 0, 0.7, 1.0), plain)
    assert searches and (plain.opacity > 0.5).any()
