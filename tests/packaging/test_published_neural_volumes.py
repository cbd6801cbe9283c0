"""``method=neural_volumes`` is the published model, to the number, where it says so.

Sources: Lombardi et al. 2019 and the figures of its released configuration.
"""

from __future__ import annotations

import pytest
from hydra.utils import instantiate

from devrf.methods.neural_volumes.settings import NeuralVolumesSettings
from devrf.methods.ray_stage import RaySchedule

METHOD = "method=neural_volumes"


def test_the_published_sizes_and_schedule(composed):
    stage = composed(METHOD, "protocol=joint").ray_stage
    settings = instantiate(stage.model.settings, _convert_="all")
    assert (settings.code, settings.encoder_views, settings.encoder_width) == (256, 3, 512)
    # Images of 512 x 334 pixels in 512 x 384; seven convolutions.
    assert list(settings.encoder_size) == [384, 512]
    assert list(settings.encoder_channels) == [64, 64, 128, 128, 256, 256, 256]
    assert list(settings.template_channels) == [1024, 512, 512, 256, 256, 128, 128]
    assert 2 ** len(settings.template_channels) == 128
    assert (settings.warp_side, settings.maps, settings.warp_scale) == (32, 16, 2 / 1024)
    assert (settings.step, settings.density_scale, settings.hull) == (4 / 256, 1.0, False)
    schedule = instantiate(stage.schedule, _convert_="all")
    assert schedule == RaySchedule(
        iterations=500_000,
        rays=16 * 128**2,
        learning_rate=1e-4,
        final_learning_rate=1e-4,
        betas=[0.9, 0.999],
        times_per_batch=16,
    )


def test_published_weights_are_converted_to_colours_between_0_and_1(composed):
    # Published colours have a deviation of 25 of 255: their squared errors are 104 times ours.
    unit = (255 / 25) ** 2
    loss = composed(METHOD, "protocol=joint").ray_stage.loss
    published = {"color": 1, "kl": 0.001, "opacity_prior": 0.01, "tv": 0.01}
    assert set(loss) == set(published)
    for name in ("kl", "opacity_prior", "tv"):
        assert loss[name] == pytest.approx(published[name] / unit, rel=2e-3)


def test_defaults_of_the_code_are_those_of_the_config(composed):
    settings = composed(METHOD, "protocol=joint").ray_stage.model.settings
    built = instantiate(settings, _convert_="all")
    for name, value in NeuralVolumesSettings().__dict__.items():
        given = getattr(built, name)
        assert (tuple(given) if isinstance(given, list) else given) == value


def test_profiles(composed):
    fast = composed(METHOD, "protocol=joint", "profile=fast").ray_stage
    assert len(fast.model.settings.template_channels) == 7
    assert (fast.schedule.iterations, fast.schedule.times_per_batch) == (50_000, 4)
    small = composed(METHOD, "protocol=joint", "profile=small").ray_stage
    assert len(small.model.settings.template_channels) == 5
    assert (small.model.settings.code, small.schedule.times_per_batch) == (64, 4)
    assert small.schedule.rays == 4 * 512
