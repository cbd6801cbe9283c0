"""Neural Volumes' parts: decoder, warp, additive opacity, priors."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from devrf.errors import DevrfError
from devrf.evaluation.held_out import truth_image
from devrf.methods.neural_volumes.capture import cameras_of_every_frame, encoder_images
from devrf.methods.neural_volumes.model import NeuralVolumes
from devrf.methods.neural_volumes.networks import (
    AffineMixWarp,
    ConvWarp,
    TimeEncoder,
    doubling,
    identity_grid,
)
from devrf.methods.neural_volumes.settings import NeuralVolumesSettings
from devrf.methods.neural_volumes.volumes import (
    Volumes,
    added_opacity,
    code_divergence,
    log_total_variation,
    opacity_prior,
)
from devrf.scenes.scene import Scene


def test_a_template_has_four_values_for_each_of_two_to_the_levels_cubed_voxels() -> None:
    model = NeuralVolumes(
        NeuralVolumesSettings(
            code=5, encoder_views=1, encoder_size=(4, 4), encoder_channels=(2,), encoder_width=3,
            template_channels=(8, 4, 4, 2), warp_side=4,
        )
    )  # fmt: skip
    volumes = model.decoded(torch.randn(3, 5))
    assert volumes.template.shape == (3, 4, 16, 16, 16)
    assert volumes.warp.shape == (3, 3, 4, 4, 4)
    color, opacity = volumes.template[:, :3], volumes.template[:, 3]
    assert 0 <= color.min() and color.max() <= 1 and opacity.min() > 0


def test_published_sizes() -> None:
    with torch.device("meta"):
        model, by_conv = NeuralVolumes(), NeuralVolumes(NeuralVolumesSettings(warp="conv"))
    # Three cameras of 256 channels at 4 x 3 places: 3 x 3072 numbers.
    assert model.encoder.joined[0].in_features == 3 * 3072
    assert model.sample_outputs < 20  # its layers are asked once a moment, not once a sample
    assert isinstance(model.warp, AffineMixWarp) and isinstance(by_conv.warp, ConvWarp)
    for decoder, side, end in (
        (model.template, 128, [128, 128, 4]),
        (by_conv.warp.decoder, 32, [3]),
    ):
        layers = [k for k in decoder.modules() if isinstance(k, torch.nn.ConvTranspose3d)]
        assert [1024] + [k.out_channels for k in layers] == [1024, 512, 512, 256, 256, *end]
        assert decoder.side == side


def test_a_doubled_volume_begins_without_a_checkerboard() -> None:
    layer = doubling(3, 2)
    made = layer(torch.randn(1, 3, 1, 1, 1).expand(1, 3, 4, 4, 4))
    inside = made[:, :, 2:-2, 2:-2, 2:-2]
    torch.testing.assert_close(inside, inside[:, :, :1, :1, :1].expand_as(inside))


def test_the_encoder_halves_images_and_shrinks_codes() -> None:
    encoder = TimeEncoder(
        NeuralVolumesSettings(
            encoder_views=2, encoder_size=(8, 16), encoder_channels=(4, 4), encoder_width=6, code=5
        )
    )
    assert encoder.joined[0].in_features == 2 * 4 * 2 * 4
    mean, log_deviation = encoder(torch.rand(3, 2, 3, 8, 16))
    assert mean.shape == log_deviation.shape == (3, 5)
    assert log_deviation.abs().max() < 0.1  # deviations begin next to 1


def test_cameras_that_miss_a_frame_are_not_encoded(tiny_scene: Scene) -> None:
    views = tiny_scene.dynamic.train
    assert cameras_of_every_frame(views) == [0, 1]
    last_of_1 = (views.view == 1).nonzero()[-1, 0]
    assert cameras_of_every_frame(views[torch.arange(len(views)) != last_of_1]) == [0]


def test_warps_begin_next_to_the_identity() -> None:
    code = torch.randn(2, 6)
    settings = NeuralVolumesSettings(
        code=6, warp_side=8, maps=3, identity_start=True, warp_channels=(4, 4, 4)
    )
    for warp in (ConvWarp(settings), AffineMixWarp(settings)):
        found = warp(code)
        torch.testing.assert_close(
            found, identity_grid(8).expand_as(found), atol=0.02, rtol=0, msg=type(warp).__name__
        )


def test_maps_begin_at_the_middle_unless_asked_and_their_weights_hold_beyond_the_grid() -> None:
    settings, code = NeuralVolumesSettings(code=6, warp_side=4, maps=1), torch.zeros(1, 6)
    assert AffineMixWarp(settings)(code).abs().max() == 0
    begun = AffineMixWarp(replace(settings, identity_start=True))
    torch.nn.init.constant_(begun.shift[-1].bias, 30.0)  # by 3: the cube is led beyond the grid
    torch.testing.assert_close(begun(code), identity_grid(4)[None] - 3, atol=1e-3, rtol=0)


def test_the_identity_warp_leaves_a_template_where_it_is(rng: torch.Generator) -> None:
    # x + 2y + 3z is trilinear: it is found again at any point of the cube.
    grid = identity_grid(5)
    values = (grid * torch.tensor([1.0, 2.0, 3.0]).view(3, 1, 1, 1)).sum(dim=0)
    volumes = Volumes(values.expand(2, 4, 5, 5, 5), identity_grid(3).expand(2, 3, 3, 3, 3))
    points = 2 * torch.rand(7, 3, generator=rng) - 1
    found = volumes.at(points, torch.tensor([1, 0, 1, 1, 0, 0, 1]))
    expected = points @ torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(found, expected[:, None].expand(7, 4))


def test_each_point_is_looked_up_in_its_own_moment() -> None:
    level = torch.tensor([0.25, 0.5, 0.75]).view(3, 1, 1, 1, 1)
    volumes = Volumes(level.expand(3, 4, 2, 2, 2), identity_grid(2).expand(3, 3, 2, 2, 2))
    found = volumes.at(torch.zeros(4, 3), torch.tensor([2, 0, 0, 1]))
    assert found[:, 3].tolist() == [0.75, 0.25, 0.25, 0.5]
    beyond = Volumes(torch.ones(1, 4, 2, 2, 2), identity_grid(2)[None] + 5)  # the template
    assert beyond.at(torch.zeros(1, 3), torch.zeros(1, dtype=torch.long)).abs().max() == 0


def test_opacity_adds_up_and_stops_at_one() -> None:
    amount = torch.tensor([0.75, 0.5, 1.0, 0.25, 0.25], requires_grad=True)
    weight, opacity = added_opacity(amount, torch.tensor([0, 0, 0, 2, 2]), 3)
    assert weight.tolist() == [0.75, 0.25, 0, 0.25, 0.25]
    assert opacity.tolist() == [1, 0, 0.5]
    # What lies behind the place where it stops is not learned.
    (gradient,) = torch.autograd.grad((weight * torch.tensor([1.0, 2, 4, 8, 16])).sum(), amount)
    assert gradient.tolist() == [1 - 2, 0, 0, 8, 16]


def test_late_rays_of_a_long_list_keep_their_digits() -> None:
    rays = 200_000
    ray = torch.arange(rays).repeat_interleave(2)
    weight, _ = added_opacity(torch.full((2 * rays,), 0.3), ray, rays)
    torch.testing.assert_close(weight[-2:], torch.tensor([0.3, 0.3]))


def test_the_opacity_prior_is_zero_where_all_or_nothing_is_seen() -> None:
    for opacity in (0.0, 1.0):
        assert opacity_prior(torch.full((3,), opacity)).item() == pytest.approx(0, abs=1e-6)
    # log 0.6 twice, and 2.20727.
    half = 2 * math.log(0.6) + 2.20727
    assert opacity_prior(torch.full((3,), 0.5)).item() == pytest.approx(half, abs=1e-5)


def test_the_divergence_of_codes() -> None:
    # s = 1: half of mu squared, the mean of 0 and 2. s = e: -1/2 - 1 + e^2/2.
    mean, none = torch.tensor([[0.0, 2.0]]), torch.zeros(1, 2)
    assert code_divergence(mean, none).item() == pytest.approx(1.0)
    one = code_divergence(torch.zeros(1, 1), torch.ones(1, 1)).item()
    assert one == pytest.approx(-1.5 + math.e**2 / 2)


def test_the_total_variation_of_log_opacity() -> None:
    opacity = torch.full((1, 2, 2, 2), 1.0)
    assert log_total_variation(opacity).item() == pytest.approx(1e-5**0.5)
    opacity[0, 1, 0, 0] = opacity[0, 0, 1, 0] = math.e  # two steps of 1 from the corner
    assert log_total_variation(opacity).item() == pytest.approx(2**0.5, rel=1e-4)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("encoder_size", (60, 64)),  # no multiples of 128
        ("template_channels", ()),
        ("warp_channels", (8, 0)),
        ("step", 0.0),
        ("encoder_views", 0),
    ],
)
def test_sizes_that_cannot_be_are_named(key: str, value: object) -> None:
    with pytest.raises(DevrfError, match=rf"ray_stage\.model\.settings\.{key}\b"):
        replace(NeuralVolumesSettings(), **{key: value})  # type: ignore[arg-type]


def test_the_encoder_sees_each_image_whole_in_the_middle(two_sizes: Scene) -> None:
    settings = NeuralVolumesSettings(encoder_views=2, encoder_size=(20, 26), encoder_channels=(2,))
    images = encoder_images(two_sizes, settings)
    train = two_sizes.dynamic.train
    for place, (rows, columns) in ((0, (18, 18)), (1, (16, 24))):
        assert int(train.frames[place]) == 0
        top, left = (20 - rows) // 2, (26 - columns) // 2
        shown = images[0, place, :, top : top + rows, left : left + columns].permute(1, 2, 0)
        truth = 255 * truth_image(train, place, two_sizes.background)
        assert truth.shape[:2] == (rows, columns)
        assert torch.equal(shown, truth.round().to(torch.uint8))
