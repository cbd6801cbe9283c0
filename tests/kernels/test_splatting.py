"""Gaussians by kernels, and their gradients, against their definition in double precision."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.kernels import splatting
from devrf.kernels.splatting import raster_of
from devrf.ops import splatting as definition
from devrf.ops.splatting import FAINTEST, STOP, Gaussians, SplatImage

NEAR = 0.2
# More than one tile across and down, on a CPU two bands.
CAMERA = Cameras.looking_at(
    torch.tensor([[1.5, -2.0, 1.0]]),
    torch.tensor([[0.1, 0.0, -0.1]]),
    focal=45.0,
    width=40,
    height=44,
)
NAMES = ("means", "scales", "quaternions", "opacity", "color", "shift")


@pytest.fixture(params=["cpu", "gpu"], autouse=True)
def tiles(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A CPU's tiles, or a GPU's, whose threads run one after another here."""
    on_gpu = request.param == "gpu"
    monkeypatch.setattr(
        splatting,
        "raster_of",
        lambda width, height, near, _: raster_of(width, height, near, on_gpu),
    )
    yield


def cloud(
    count: int, rng: torch.Generator, spread: float = 0.6, size: float = 0.15
) -> list[Tensor]:
    """Random Gaussians around the point looked at, some opaque, and no shift."""
    return [
        spread * torch.randn(count, 3, generator=rng),
        size * (0.5 * torch.randn(count, 3, generator=rng)).exp(),
        torch.randn(count, 4, generator=rng),
        (1 + 1.5 * torch.randn(count, generator=rng)).sigmoid(),
        torch.rand(count, 3, generator=rng),
        torch.zeros(count, 2),
    ]


def picture(how: object, tensors: list[Tensor], camera: Cameras = CAMERA) -> SplatImage:
    image: SplatImage = how.splat(Gaussians(*tensors[:5]), camera, NEAR, tensors[5])  # type: ignore[attr-defined]
    return image


def compared(
    tensors: list[Tensor],
    rng: torch.Generator,
    camera: Cameras = CAMERA,
    tolerance: float = 1e-5,
    of_slopes: float = 2e-5,
) -> tuple[SplatImage, list[Tensor]]:
    """The picture and the gradients of a random linear function; both are the definition's."""
    pixels = camera.width * camera.height
    factors = [torch.randn(pixels, *shape, generator=rng) for shape in ((3,), (), ())]
    results = []
    for how, dtype in ((splatting, torch.float32), (definition, torch.float64)):
        leaves = [each.detach().to(dtype).requires_grad_() for each in tensors]
        image = picture(how, leaves, camera)
        outputs = [image.color, image.depth, image.transmittance]
        sum((f.to(dtype) * o).sum() for f, o in zip(factors, outputs, strict=True)).backward()
        results.append((image, [leaf.grad for leaf in leaves]))
    (ours, slopes), (theirs, true_slopes) = results
    for name in ("color", "depth", "transmittance"):
        one, other = getattr(ours, name).double(), getattr(theirs, name)
        torch.testing.assert_close(one, other, atol=tolerance, rtol=tolerance, msg=name)
    for name, one, other in zip(NAMES, slopes, true_slopes, strict=True):
        scale = other.abs().max().clamp(min=1e-6) if len(other) else 1.0
        error = f"gradient of {name}"
        torch.testing.assert_close(
            one.double() / scale, other / scale, atol=of_slopes, rtol=0, msg=error
        )
    return ours, slopes


@pytest.mark.parametrize("count", [1, 30, 200])
def test_pictures_and_gradients_are_those_of_the_definition(
    count: int, rng: torch.Generator
) -> None:
    image, slopes = compared(cloud(count, rng), rng)
    assert all(slope.any() for slope in slopes)
    if count == 200:
        left = image.transmittance
        assert (left < STOP).any() and ((left > 0.1) & (left < 0.9)).any() and (left == 1).any()


def test_gaussians_at_the_border_and_far_beside_it(rng: torch.Generator) -> None:
    # The camera stands among them: most are outside, beyond the margin where slopes are bounded.
    camera = Cameras.looking_at(
        torch.tensor([[0.2, 0.1, 0.0]]),
        torch.tensor([[3.0, 0.0, 0.1]]),
        focal=30.0,
        width=37,
        height=50,
    )
    tensors = cloud(120, rng, spread=1.5, size=0.2)
    _, slopes = compared(tensors, rng, camera)
    position, ahead = camera.positions[0], camera.forwards[0]
    depth = (tensors[0] - position) @ ahead
    behind, seen = depth < NEAR, slopes[0].any(dim=1)
    assert behind.sum() > 20 and seen.sum() > 10 and not seen[behind].any()
    pixel, _ = camera.project_into(0, tensors[0])
    size = torch.tensor([37.0, 50.0])
    outside = ((pixel < -0.15 * size) | (pixel > 1.15 * size)).any(dim=1)
    assert (seen & outside).any()


def test_one_that_fills_a_wide_picture(rng: torch.Generator) -> None:
    camera = CAMERA.resized(400, 44)
    tensors = cloud(3, rng, spread=0.05, size=0.5)
    image, _ = compared(tensors, rng, camera, tolerance=3e-5)
    assert (image.transmittance.view(44, 400) < 0.9).sum(dim=1).max() > 200


def test_needles(rng: torch.Generator) -> None:
    # Hundreds of pixels long, and thinner than one.
    tensors = cloud(20, rng)
    tensors[1] = torch.tensor([[6.0, 1e-3, 1e-3]]).repeat(20, 1)
    image, _ = compared(tensors, rng, tolerance=5e-4, of_slopes=2e-3)
    assert (image.transmittance < 0.9).sum() > 100


def test_one_pixel_and_nothing_to_see(rng: torch.Generator) -> None:
    pixel = CAMERA.resized(1, 1)
    image, slopes = compared(cloud(20, rng), rng, pixel)
    assert image.color.shape == (1, 3) and image.transmittance < 0.9 and slopes[0].any()
    behind = cloud(20, rng)
    behind[0] = behind[0] + 10 * (CAMERA.positions - torch.tensor([[0.1, 0.0, -0.1]]))
    faint = [*cloud(20, rng)[:3], torch.full((20,), 0.99 * FAINTEST), *cloud(20, rng)[4:]]
    for tensors in (cloud(0, rng), behind, faint):
        image, slopes = compared(tensors, rng)
        assert (image.transmittance == 1).all() and not image.color.any()
        assert not any(slope.any() for slope in slopes)


def test_numbers_that_are_none_are_not_shown(rng: torch.Generator) -> None:
    tensors = cloud(5, rng)
    tensors[0][0, 1] = torch.nan
    tensors[3][1] = torch.nan
    image = picture(splatting, tensors)
    assert image.color.isfinite().all()
    alone = picture(splatting, [each[2:] for each in tensors])
    assert torch.equal(image.color, alone.color)


def test_a_picture_whose_tiles_take_all_memory_is_refused(rng: torch.Generator) -> None:
    tensors = [each.repeat(20_000, *(1,) * (each.ndim - 1)) for each in cloud(10, rng, size=100)]
    with pytest.raises(DevrfError, match="200000 Gaussians lie in [0-9]* tiles of a"):
        picture(splatting, tensors, CAMERA.resized(16, 16_384))


def test_a_picture_without_gradients_keeps_nothing(rng: torch.Generator) -> None:
    tensors = cloud(10, rng)
    assert not picture(splatting, tensors).color.requires_grad
    tensors[4].requires_grad_()
    picture(splatting, tensors).color.sum().backward()
    assert tensors[4].grad.any() and all(each.grad is None for each in tensors[:4])
