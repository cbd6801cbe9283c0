"""Pixels become batches: rows and columns, backgrounds, flow, on images that are not square."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.data.batch import (
    BackgroundColor,
    FrameSortedPixels,
    PixelPool,
    all_pixels,
    concatenated,
    gather_image,
    wanted_pixels,
)
from devrf.geometry.cameras import Cameras, pixel_positions
from devrf.methods.batch import gather_batch
from devrf.scenes.scene import OpticalFlow, Views

WIDTH, HEIGHT = 4, 3


def views(channels: int = 4, flow: bool = True) -> Views:
    """Two images; red is 100·image + 10·row + column, alpha half; flow is (x, −y) of a pixel."""
    image, row, column = torch.meshgrid(
        torch.arange(2), torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij"
    )
    red = 100 * image + 10 * row + column
    pixels = torch.stack([red, 0 * red, 0 * red + 255, 0 * red + 51], dim=-1)[..., :channels]
    cameras = Cameras(
        torch.eye(3, 4)[None].repeat(2, 1, 1),
        torch.tensor([[5.0, 5.0], [7.0, 6.0]]),
        torch.tensor([[2.0, 1.5]] * 2),
        WIDTH,
        HEIGHT,
    )
    vectors = torch.stack([column + 0.5, -(row + 0.5)], dim=-1)
    return Views(
        pixels.to(torch.uint8),
        cameras,
        torch.tensor([0.25, 1.0]),
        torch.tensor([0, 0]),
        ("a", "b"),
        OpticalFlow(vectors, column > row) if flow else None,
        frames=torch.tensor([1, 4]),
    )


# Image 1, row 2, column 1; image 0, row 0, column 3.
IMAGE, FLAT = torch.tensor([1, 0]), torch.tensor([9, 3])


def test_pixel_positions_are_x_then_y():
    assert pixel_positions(FLAT, WIDTH).tolist() == [[1.5, 2.5], [3.5, 0.5]]
    quarters = pixel_positions(FLAT[:1], WIDTH, per_pixel=4)
    assert quarters.tolist() == [[1.25, 2.25], [1.75, 2.25], [1.25, 2.75], [1.75, 2.75]]
    # One diagonal and the other, in turn.
    pairs = pixel_positions(FLAT, WIDTH, per_pixel=2)
    assert pairs.tolist() == [[1.25, 2.25], [1.75, 2.75], [3.75, 0.25], [3.25, 0.75]]


def test_an_image_is_composited_cut_to_rows_and_shrunk():
    seen = replace(views(), valid_mask=torch.ones(2, HEIGHT, WIDTH, dtype=torch.bool))
    seen.valid_mask[1, 2, 3] = False
    background = torch.tensor([1.0, 0.0, 0.0])
    batch = gather_image(seen, 1, background, rows=(1, 3), shrink=2)
    assert (batch.camera.width, batch.camera.height, batch.time) == (2, 1, 1.0)
    assert batch.camera.focal.tolist() == [[3.5, 3.0]]
    assert batch.camera.center.tolist() == [[1.0, 0.25]]  # (2, 1.5 - 1) / 2
    # Columns 0 and 1 of rows 1 and 2: 115.5 on average, a fifth of it before red.
    assert batch.color[0].tolist() == pytest.approx([0.2 * 115.5 / 255 + 0.8, 0.0, 0.2])
    assert batch.alpha.tolist() == pytest.approx([0.2, 0.2])
    assert batch.valid.tolist() == [True, False]
    whole = gather_image(views(3), 0, background, rows=(0, HEIGHT))
    assert whole.alpha is None and whole.valid is None
    assert whole.color[:, 0].tolist() == pytest.approx(
        [(10 * row + column) / 255 for row in range(HEIGHT) for column in range(WIDTH)]
    )


def test_a_batch_holds_the_right_pixels_with_their_flow():
    batch = gather_batch(views(), IMAGE, FLAT, torch.zeros(3))
    assert batch.pixel.tolist() == [[1.5, 2.5], [3.5, 0.5]]
    assert batch.flow is not None and batch.flow_valid is not None
    assert batch.flow_valid.tolist() == [False, True]
    assert batch.flow.tolist() == [[0, 0], [3.5, -0.5]]  # nothing where it is not valid
    assert batch.image.tolist() == [1, 0]
    assert batch.time.tolist() == [1.0, 0.25] and batch.frame.tolist() == [4, 1]
    # On black, colour times alpha 51/255.
    torch.testing.assert_close(batch.color[:, 0], torch.tensor([121, 3]) / 255 * 0.2)


def test_rays_belong_to_the_cameras_of_their_images():
    data = views()
    batch = gather_batch(data, IMAGE, FLAT, torch.zeros(3))
    expected = data.cameras.rays(IMAGE, batch.pixel)
    torch.testing.assert_close(batch.rays.directions, expected.directions)
    # ((1.5 − 2)/7, −(2.5 − 1.5)/6, −1) for image 1.
    ray = torch.nn.functional.normalize(torch.tensor([-0.5 / 7, -1 / 6, -1.0]), dim=0)
    torch.testing.assert_close(batch.rays.directions[0], ray)


@pytest.mark.parametrize(
    "background", [torch.tensor([1.0, 1.0, 1.0]), torch.tensor([[1.0, 0.0, 0.5], [0.2, 0.4, 0.6]])]
)
def test_alpha_masks_are_composited_on_one_background_or_one_a_ray(background):
    batch = gather_batch(views(), IMAGE, FLAT, background)
    rgb = torch.tensor([[121 / 255, 0.0, 1.0], [3 / 255, 0.0, 1.0]])
    torch.testing.assert_close(batch.color, 0.2 * rgb + 0.8 * background)
    assert batch.alpha is not None
    torch.testing.assert_close(batch.alpha, torch.tensor([0.2, 0.2]))


def test_a_pixel_has_several_rays_that_share_its_truth():
    background = torch.tensor([[1.0, 0.0, 0.5], [0.2, 0.4, 0.6]])
    single = gather_batch(views(), IMAGE, FLAT, background)
    batch = gather_batch(views(), IMAGE, FLAT, background, per_pixel=4)
    assert (len(batch.rays), batch.per_pixel, single.per_pixel) == (8, 4, 1)
    assert torch.equal(batch.pixel, pixel_positions(FLAT, WIDTH, per_pixel=4))
    expected = views().cameras.rays(batch.image, batch.pixel)
    torch.testing.assert_close(batch.rays.directions, expected.directions)
    for name in ("color", "alpha", "time", "frame", "image", "background", "flow", "flow_valid"):
        truth = getattr(single, name)
        assert torch.equal(getattr(batch, name), truth.repeat_interleave(4, dim=0)), name


def test_images_without_alpha_or_flow():
    batch = gather_batch(views(channels=3, flow=False), IMAGE, FLAT, torch.zeros(3))
    assert batch.alpha is None and batch.flow is None and batch.flow_valid is None
    torch.testing.assert_close(batch.color[0], torch.tensor([121 / 255, 0.0, 1.0]))


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("per_pixel", [1, 2, 4])
@pytest.mark.parametrize("flow", [False, True])
def test_a_kernel_looks_up_what_the_definition_does(
    channels: int,
    flow: bool,
    per_pixel: int,
    rng: torch.Generator,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shown = views(channels, flow)
    poses = Cameras.looking_at(
        torch.randn(2, 3, generator=rng), torch.zeros(2, 3), focal=4.0, width=WIDTH, height=HEIGHT
    )
    cameras = replace(shown.cameras, camera_to_world=poses.camera_to_world)
    shown = replace(shown, cameras=cameras)
    image = torch.randint(2, (50,), generator=rng)
    flat = torch.randint(WIDTH * HEIGHT, (50,), generator=rng)
    behind = torch.rand(50, 3, generator=rng)
    ours = gather_batch(shown, image, flat, behind, per_pixel=per_pixel)
    monkeypatch.setattr("devrf.kernels.runtime._chosen", "torch")
    theirs = gather_batch(shown, image, flat, behind, per_pixel=per_pixel)
    for name in ("color", "alpha", "time", "frame", "image", "pixel", "flow", "flow_valid"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name))
    for name in ("origins", "directions", "viewdirs"):
        torch.testing.assert_close(getattr(ours.rays, name), getattr(theirs.rays, name))


def test_flow_that_is_not_valid_may_be_anything() -> None:
    data = views()
    assert data.flow is not None
    data.flow.vectors[~data.flow.valid] = torch.nan
    flow = gather_batch(data, IMAGE, FLAT, torch.zeros(3)).flow
    assert flow is not None and flow.tolist() == [[0, 0], [3.5, -0.5]]


def test_batches_become_one(rng: torch.Generator) -> None:
    opaque = gather_batch(views(channels=3), IMAGE, FLAT, torch.zeros(3))
    behind = torch.rand(2, 3, generator=rng)
    both = concatenated([opaque, gather_batch(views(), IMAGE, FLAT, behind)])
    assert both.alpha is not None
    torch.testing.assert_close(both.alpha, torch.tensor([1.0, 1.0, 0.2, 0.2]))
    assert torch.equal(both.background, torch.cat([torch.zeros(2, 3), behind]))
    assert both.frame.tolist() == [4, 1] * 2 and both.time.tolist() == [1.0, 0.25] * 2
    assert torch.equal(both.rays.origins[2:], opaque.rays.origins) and len(both.rays) == 4
    assert both.flow is None and both.flow_valid is None


def test_backgrounds(rng: torch.Generator) -> None:
    image = torch.zeros(5, dtype=torch.long)
    white = BackgroundColor("white")
    assert white(image, rng).tolist() == [1, 1, 1] and white(image, rng) is white(image, rng)
    assert BackgroundColor("black")(image, rng).tolist() == [0, 0, 0]
    drawn = BackgroundColor("random")(image, rng)
    assert drawn.shape == (5, 3) and len(drawn.unique(dim=0)) == 5


def test_all_pixels_of_some_images():
    pool = all_pixels(views(), torch.tensor([1, 0]))
    assert len(pool) == 2 * WIDTH * HEIGHT
    assert pool.image.tolist() == [1] * 12 + [0] * 12
    assert pool.flat.tolist() == list(range(12)) * 2


def test_draws_come_from_the_pool_and_reach_all_of_it(rng):
    pool = PixelPool(torch.tensor([[0, 1, 1], [7, 2, 5]], dtype=torch.int32))
    image, flat = pool.draw(200, rng)
    assert image.dtype == flat.dtype == torch.int64
    drawn = set(zip(image.tolist(), flat.tolist(), strict=True))
    assert drawn == {(0, 7), (1, 2), (1, 5)}


def test_a_pool_is_told_by_its_mask():
    whole = all_pixels(views(), torch.arange(2))
    some = PixelPool(whole.pixels[:, 1::3])
    of_second = some[some.image == 1]
    for pool, images in ((some, torch.arange(2)), (of_second, torch.tensor([1]))):
        mask = pool.mask(images, WIDTH * HEIGHT)
        assert mask.sum() == len(pool)
        again = PixelPool.of_mask(images, mask)
        assert torch.equal(again.image, pool.image) and again.image.dtype == torch.int32
        assert torch.equal(again.flat, pool.flat) and again.flat.dtype == torch.int32


def test_what_is_wanted_but_does_not_count_is_left_out():
    shown = views()
    area = shown.height * shown.width
    wanted = torch.zeros(2, area, dtype=torch.bool)
    wanted[0, [1, 2]] = wanted[1, 3] = True
    images = torch.tensor([1, 0])
    pool = wanted_pixels(shown, images, wanted)
    assert list(zip(pool.image.tolist(), pool.flat.tolist(), strict=True)) == [
        (1, 1),
        (1, 2),
        (0, 3),
    ]
    valid_mask = torch.ones(len(shown), shown.height, shown.width, dtype=torch.bool)
    valid_mask[1, 0, 1] = False
    pool = wanted_pixels(replace(shown, valid_mask=valid_mask), images, wanted)
    assert list(zip(pool.image.tolist(), pool.flat.tolist(), strict=True)) == [(1, 2), (0, 3)]


def test_what_is_beside_an_image_is_never_drawn(two_sizes):
    shown = two_sizes.static.train
    pool = all_pixels(shown, torch.arange(2))
    places = set(zip(pool.image.tolist(), pool.flat.tolist(), strict=True))
    # Image 0 has 18 of 24 columns and 18 rows, image 1 16 of the rows.
    first = {(0, 24 * row + column) for row in range(18) for column in range(18)}
    assert places == first | {(1, number) for number in range(24 * 16)}
    # The middle is that of the image: rows 4 to 13 and columns 4 to 13 of 18.
    middle = FrameSortedPixels.of(shown[torch.tensor([0])], centre=True).pool
    inner = {24 * row + column for row in range(4, 14) for column in range(4, 14)}
    assert set(middle.flat.tolist()) == inner
