"""Voxel grids and the canonical field: look-up, resizing, densities by the paper's formulas."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.kernels.march import march
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_field import CanonicalField, VoxelGrid
from devrf.methods.devrf.color_decoder import ColorDecoder, SigmoidColor
from devrf.methods.devrf.volume_rendering import march_inputs
from devrf.ops.compositing import composite
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import RenderSettings

SMALL = Architecture(channels=4, width=8, frequencies=2)


BOX = Box((-1.0, 0.0, 2.0), (3.0, 2.0, 3.0))
# A forward-facing field, in normalised device coordinates.
PLANES, AHEAD = 16, Box((-1.5, -1.0, -1.0), (1.5, 1.0, 1.0))


def test_resizing_keeps_a_linear_function_exactly(rng):
    slope = torch.tensor([[1.0, -2.0], [0.5, 0.0], [3.0, 1.0]])
    grid, (low, high) = VoxelGrid((5, 4, 3), 2), BOX.corners(torch.zeros(()))
    with torch.no_grad():
        grid.values.copy_(BOX.grid_points((5, 4, 3), grid.values) @ slope + 0.25)
    points = low + (high - low) * torch.rand(100, 3, generator=rng)
    for shape in ((5, 4, 3), (9, 7, 5), (3, 2, 2)):
        grid.resize(shape)
        assert grid.shape == shape and grid.values.requires_grad and grid.values.is_leaf
        torch.testing.assert_close(grid(points, BOX), points @ slope + 0.25)


def test_a_resized_grid_lies_in_memory_as_a_new_one():
    # A single channel may keep a stray stride, which makes look-ups slow and not bit-equal.
    grid = VoxelGrid((3, 3, 3), 1)
    grid.resize((4, 5, 6))
    assert grid.values.stride() == VoxelGrid((4, 5, 6), 1).values.stride()


def opacity(field: CanonicalField, delta: float) -> Tensor:
    return -torch.expm1(-field.optical_depth(torch.zeros(1, 3), delta))


def test_the_same_length_has_the_same_opacity_at_every_resolution(cube):
    # 512 voxels at full size, 64 now: a voxel is twice a base voxel, half a voxel is one.
    field = SMALL.radiance_field(cube, 64, 512)
    assert field.step_length(1.0) == pytest.approx(0.5)
    assert field.step_in_base_voxels(0.5) == pytest.approx(1.0)
    assert field.voxel_alpha(0.5).max().item() == pytest.approx(1e-2, rel=1e-4)
    field.resize(512)
    assert field.density.shape == field.color.shape == (8, 8, 8)
    assert field.step_in_base_voxels(0.5) == pytest.approx(0.5)
    assert field.voxel_alpha(0.5).max().item() == pytest.approx(1 - math.sqrt(0.99), rel=1e-4)


def test_optical_depth_by_hand(cube):
    field = SMALL.radiance_field(cube, 8, 8)
    with torch.no_grad():
        field.density.values.fill_(2.0)
        field.density.values[1] = 4.0
    # Interpolated first: 3 in the middle; then softplus(3 + b) · δ.
    expected = math.log1p(math.exp(3 + field.shift)) * 0.5
    assert field.optical_depth(torch.zeros(1, 3), 0.5).item() == pytest.approx(expected, rel=1e-5)


def test_clearing_leaves_almost_nothing_there_and_all_elsewhere(cube):
    field = SMALL.radiance_field(cube, 64, 64)
    with torch.no_grad():
        field.density.values.normal_(3.0)
        field.density.values[3, 3, 3] = -60.0
    before = field.density.values.detach().clone()
    where = torch.zeros(4, 4, 4, dtype=torch.bool)
    where[1:, 2:] = True
    field.clear(where, 1e-6)
    # A step of one voxel is one base voxel here.
    assert field.voxel_alpha(1.0)[where].max().item() == pytest.approx(1e-6, rel=1e-2)
    assert torch.equal(field.density.values[~where], before[~where])
    # What was emptier already stays as it was.
    assert field.density.values[3, 3, 3].item() == -60.0


def test_the_decoder_is_the_network_of_the_concatenated_input(rng):
    decoder = ColorDecoder(channels=3, width=6, frequencies=4)
    features, ray = torch.randn(5, 3, generator=rng), torch.tensor([0, 0, 1, 1, 1])
    dirs = torch.nn.functional.normalize(torch.randn(2, 3, generator=rng), dim=1)
    waves = [f(2**k * dirs) for f in (torch.sin, torch.cos) for k in range(4)]
    encoded = torch.cat([dirs, *waves], dim=1)[ray]
    weight = torch.cat([decoder.from_feature.weight, decoder.from_direction.weight], dim=1)
    x = torch.relu(torch.cat([features, encoded], 1) @ weight.T + decoder.from_feature.bias)
    expected = torch.sigmoid(decoder.output(torch.relu(decoder.hidden(x))))
    torch.testing.assert_close(decoder(features, dirs, ray), expected)


def test_directions_can_be_forgotten_and_are_learned_when_they_are_let(rng):
    field = SMALL.radiance_field(Box((0.0,) * 3, (1.0,) * 3), 27, 27)
    field.forget_directions()
    points, ray, dirs = torch.rand(3, 3, generator=rng), torch.zeros(3).long(), torch.eye(3)
    seen = [field.rgb(points, dirs[k : k + 1], ray) for k in range(3)]
    assert torch.equal(seen[0], seen[1]) and torch.equal(seen[0], seen[2])
    assert isinstance(field.decoder, ColorDecoder)
    weight = field.decoder.from_direction.weight
    field.learn_directions(False)
    field.rgb(points, dirs[:1], ray).sum().backward()
    assert weight.grad is None and field.decoder.hidden.weight.grad is not None
    field.learn_directions(True)
    field.rgb(points, dirs[:1], ray).sum().backward()
    assert weight.grad is not None and bool(weight.grad.any())


def test_the_search_field_shows_its_channels_through_a_sigmoid(cube):
    field = SMALL.search_field(cube, 64)
    with torch.no_grad():
        field.color.values.copy_(torch.tensor([0.0, 1.0, -1.0]).expand(4, 4, 4, 3))
    seen = field.rgb(torch.zeros(1, 3), torch.eye(3)[:1], torch.zeros(1, dtype=torch.long))
    torch.testing.assert_close(seen, torch.tensor([[0.5, 0.7310586, 0.2689414]]))
    assert list(field.decoder.parameters()) == []
    assert opacity(field, 1.0).item() == pytest.approx(1e-6, rel=1e-3)


def planes(voxels: int = 24 * 16 * PLANES) -> CanonicalField:
    return CanonicalField(
        AHEAD, SigmoidColor(), channels=3, voxels=voxels, alpha_init=1e-2, planes=PLANES
    )


def test_every_plane_starts_with_an_equal_share_and_the_last_one_is_opaque():
    field = planes()
    points = torch.stack(
        [torch.full((PLANES,), 0.2), torch.full((PLANES,), 0.1), torch.linspace(-1, 1, PLANES)], 1
    )
    tau = field.optical_depth(points, field.step_in_base_voxels(1.0))
    weight, end = composite(tau, torch.zeros(PLANES, dtype=torch.long), 1)
    torch.testing.assert_close(weight, torch.full((PLANES,), 1 / PLANES), atol=1e-4, rtol=0)
    assert float(end.detach()) < 1e-5


def test_samples_are_evenly_spaced_from_the_first_plane_to_the_last():
    field = planes()
    # From the near plane at z = −1 to infinity at z = 1, as rays in NDC are.
    ray = Rays(*(torch.tensor([v]) for v in ([0.2, 0.1, -1.0], [0.0, 0.0, 2.0], [0.0, 0.0, -1.0])))
    everywhere = Occupancy.full(field.density.shape, AHEAD)
    settings = RenderSettings(step=0.5, alpha_threshold=0.0, near=0.0, far=1.0)
    with torch.no_grad():
        field.density.values.fill_(-60.0)  # nothing is hidden
        samples = march(ray, march_inputs(field, everywhere, settings))
    count = (PLANES - 1) * 2 + 1
    assert len(samples.ray) == count
    depth = samples.points[:, 2]
    torch.testing.assert_close(depth, torch.linspace(-1, 1, count), atol=1e-5, rtol=0)
