"""The canonical field of a forward-facing scene: planes in normalised device coordinates."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.color_decoder import SigmoidColor
from devrf.ops.compositing import composite
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import march

PLANES = 16
BOX = Box((-1.5, -1.0, -1.0), (1.5, 1.0, 1.0))


def planes(voxels: int = 24 * 16 * PLANES) -> CanonicalField:
    return CanonicalField(
        BOX, SigmoidColor(), channels=3, voxels=voxels, alpha_init=1e-2, planes=PLANES
    )


def straight_ray() -> Rays:
    """From the near plane at z = −1 to infinity at z = 1, as NDC rays are."""
    return Rays(*(torch.tensor([v]) for v in ([0.2, 0.1, -1.0], [0.0, 0.0, 2.0], [0.0, 0.0, -1.0])))


def test_every_plane_starts_with_an_equal_share_and_the_last_one_is_opaque() -> None:
    field = planes()
    points = torch.stack(
        [torch.full((PLANES,), 0.2), torch.full((PLANES,), 0.1), torch.linspace(-1, 1, PLANES)], 1
    )
    tau = field.optical_depth(points, field.step_in_base_voxels(1.0))
    weight, end = composite(tau, torch.zeros(PLANES, dtype=torch.long), 1)
    torch.testing.assert_close(weight, torch.full((PLANES,), 1 / PLANES), atol=1e-4, rtol=0)
    assert float(end.detach()) < 1e-5


def test_samples_are_evenly_spaced_from_the_first_plane_to_the_last() -> None:
    field, ray = planes(), straight_ray()
    everywhere = Occupancy.full(field.density.shape, BOX)
    samples = march(ray, BOX, everywhere, step=field.step_length(0.5), near=0.0, far=1.0)
    assert len(samples) == (PLANES - 1) * 2 + 1
    depth = samples.points[:, 2]
    torch.testing.assert_close(depth, torch.linspace(-1, 1, len(samples)), atol=1e-5, rtol=0)


@pytest.mark.parametrize("voxels", [24 * 16 * PLANES, 12 * 8 * PLANES])
def test_planes_stay_while_the_grid_grows_across(voxels: int) -> None:
    field = planes(voxels=6 * 4 * PLANES)
    assert field.density.shape == (6, 4, PLANES)
    field.resize(voxels)
    assert field.density.shape == (
        round((voxels / PLANES * 1.5) ** 0.5),
        round((voxels / PLANES / 1.5) ** 0.5),
        PLANES,
    )
    assert field.step_in_base_voxels(0.5) == pytest.approx(0.5 * 256 / PLANES)


def test_the_paper_s_grid_is_256_by_256_by_128() -> None:
    square = Box((-1.2, -1.2, -1.0), (1.2, 1.2, 1.0))
    field = CanonicalField(
        square, SigmoidColor(), channels=3, voxels=8, alpha_init=1e-2, planes=128
    )
    assert field.grid_shape(round(203.18733465**3)) == (256, 256, 128)
