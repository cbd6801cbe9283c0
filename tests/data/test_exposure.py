"""The exposure of a film's images: found to a few hundredths, made equal, told by half an image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from devrf.data.exposure import _equal, exposures, with_equal_exposure
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.export import export
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.procedural import ProceduralForwardScene
from devrf.scenes.scene import Capture, Scene, Views


@pytest.fixture(scope="module")
def film() -> Scene:
    """What one hand films in 18 images, all of one exposure."""
    return ProceduralForwardScene(
        camera="handheld", frames=18, width=64, height=48, supersample=1, texture="fine"
    )()


def lit(views: Views, theta: Tensor) -> Views:
    """The views with exposures ``theta`` (N, 3), log(gain)."""
    bright = views.pixels.float() * theta.exp()[:, None, None]
    return replace(views, pixels=bright.round().clamp(0, 255).to(torch.uint8))


def drifting(views: Views) -> Tensor:
    """(N, 3) exposures that fall by a third, blue with a step back, in the order of the times."""
    red = -0.4 * views.times
    return torch.stack([red, red, red + 0.2 * (views.times > 0.5)], dim=1)


def filmed(scene: Scene, change: float = 1.0) -> Scene:
    """The film with exposures that drift, ``change`` times as much."""
    train = lit(scene.dynamic.train, change * drifting(scene.dynamic.train))
    test = lit(scene.dynamic.test, change * drifting(scene.dynamic.test))
    capture = Capture(train, test)
    return replace(scene, static=capture, dynamic=capture)


def test_exposures_are_found_whatever_the_order_of_the_images(film):
    train = film.dynamic.train[torch.randperm(18)]
    true = drifting(train)
    bare = exposures(train)
    found = exposures(lit(train, true))
    assert bare is not None and found is not None
    torch.testing.assert_close(found.mean(dim=0), torch.zeros(3), atol=1e-6, rtol=0)
    assert float(bare.abs().max()) < 0.03
    assert float((found - true + true.mean(dim=0)).abs().max()) < 0.05


def test_of_a_long_film_some_images_are_compared(film, monkeypatch):
    monkeypatch.setattr("devrf.data.exposure.MOST", 9)
    true = drifting(film.dynamic.train)[:, 0]
    found = exposures(lit(film.dynamic.train, drifting(film.dynamic.train)))
    assert found is not None and found.shape == (18, 3)
    assert float((found[:, 0] - true + true.mean()).abs().max()) < 0.06


def test_an_image_that_cannot_be_followed_has_an_exposure_in_between(film, monkeypatch):
    monkeypatch.setattr("devrf.data.exposure.PAIRS", 0.8)  # two of 17 pairs are lost with it
    train = film.dynamic.train
    true = torch.linspace(0.2, -0.2, 18)[:, None].expand(18, 3)
    dim = lit(train, true)
    for lost, expected in ((9, true[9, 0]), (17, true[16, 0])):
        pixels = dim.pixels.clone()
        pixels[lost] = torch.randint(0, 256, pixels.shape[1:], dtype=torch.uint8)
        found = exposures(replace(dim, pixels=pixels))
        assert found is not None
        assert float((found[lost] - found[0] - expected + true[0, 0]).abs().max()) < 0.06


def test_images_at_one_time_have_exposures_of_their_own(film):
    train = film.dynamic.train
    true = 0.2 * (-1.0) ** torch.arange(18)[:, None].expand(18, 3)
    found = exposures(replace(lit(train, true), times=(torch.arange(18) // 2) / 8))
    assert found is not None and float((found - true).abs().max()) < 0.06


def test_films_that_do_not_hang_together_are_left_alone(film, monkeypatch):
    monkeypatch.setattr("devrf.data.exposure.APART", (1,))
    train = film.dynamic.train
    pixels = train.pixels.clone()
    pixels[9:] = pixels[9:].flip(1).flip(3)  # another place
    assert exposures(train) is not None
    monkeypatch.setattr("devrf.data.exposure.PAIRS", 0.8)
    assert exposures(replace(train, pixels=pixels)) is None


def test_images_are_made_equal_where_they_drift(film, caplog):
    caplog.set_level("INFO")
    made = with_equal_exposure(filmed(film), "auto")
    assert "exposure changes by" in caplog.text and "made equal" in caplog.text
    assert made.static.train is made.dynamic.train and made.static.validation is None
    colors = made.dynamic.train.pixels.float()
    true = film.dynamic.train.pixels.float()
    off = (colors / true.clamp(min=1)).flatten(1, 2).median(dim=1).values
    assert float((off / off.mean(dim=0) - 1).abs().max()) < 0.06
    test = made.dynamic.test
    assert torch.equal(test.pixels, filmed(film).dynamic.test.pixels)  # as they are
    assert test.valid_mask is not None and test.exposure_mask is not None
    assert not (test.valid_mask & test.exposure_mask).any()
    assert not test.valid_mask[..., :32].any() and not test.exposure_mask[..., 32:].any()
    # What is left out stays so.
    assert torch.equal(test.valid_mask | test.exposure_mask, film.dynamic.test.valid_mask)


def test_what_is_too_bright_tells_no_colour(film):
    scene = filmed(film)
    train = scene.dynamic.train
    burnt = train.pixels.clone()
    burnt[:, 10:14, 20:24] = 255
    capture = replace(scene.dynamic, train=replace(train, pixels=burnt))
    made = with_equal_exposure(replace(scene, static=capture, dynamic=capture), "auto")
    valid = made.dynamic.train.valid_mask
    # At first images are brighter than their mean: what was there was brighter than could be told;
    # at last darker: it is brighter than can be told now.
    assert not valid[0, 10:14, 20:24].any() and not valid[-1, 10:14, 20:24].any()
    assert valid[:, 20:].all()
    colors = made.dynamic.train.pixels[valid]
    assert float(colors.float().mean()) < 200
    # Exposures that hardly differ leave it as it was.
    for trifle in (0.005, -0.005):
        same = _equal(replace(train, pixels=burnt), torch.full((18, 3), trifle))
        assert same.valid_mask.all()


def test_a_held_out_image_that_shows_nothing_on_its_right_is_scored_on_its_left(film):
    left = torch.zeros_like(film.dynamic.test.valid_mask)
    left[0, :, 10:20] = left[1:, :, 40:50] = True
    test = replace(film.dynamic.test, valid_mask=left)
    scene = replace(film, dynamic=replace(film.dynamic, test=test))
    made = with_equal_exposure(scene, "equal").dynamic.test
    assert torch.equal(made.valid_mask, left) and made.exposure_mask[0].any()


def test_halves_are_those_of_each_image(film):
    test = film.dynamic.test
    sizes = torch.tensor([[test.width - 10, test.height]]).repeat(len(test), 1)
    inside = (torch.arange(test.width) < test.width - 10).expand(test.pixels.shape[:3])
    cameras = replace(test.cameras, sizes=sizes)
    cut = replace(test, cameras=cameras, valid_mask=inside)
    scene = replace(film, dynamic=replace(film.dynamic, test=cut))
    made = with_equal_exposure(scene, "equal").dynamic.test
    middle = (test.width - 10) // 2
    assert made.exposure_mask[:, :, :middle].all() and made.valid_mask[:, :, middle:-10].all()
    assert not (made.exposure_mask[:, :, middle:].any() or made.valid_mask[:, :, :middle].any())


@pytest.mark.parametrize(
    ("change", "choice", "made"),
    [(0.2, "auto", False), (0.2, "equal", True), (1.0, "none", False), (1.0, "auto", True)],
)
def test_the_choice(film, change, choice, made):
    scene = filmed(film, change)
    assert (with_equal_exposure(scene, choice) is not scene) == made


def test_what_is_no_film_is_left_alone(film, tiny_scene):
    assert with_equal_exposure(tiny_scene, "equal") is tiny_scene  # fixed cameras
    train = film.dynamic.train
    noise = torch.randint(0, 256, train.pixels.shape, dtype=torch.uint8)
    leaps = Capture(replace(train, pixels=noise), film.dynamic.test)
    scene = replace(film, static=leaps, dynamic=leaps)
    assert exposures(scene.dynamic.train) is None
    assert with_equal_exposure(scene, "equal") is scene


def test_a_film_from_disk_is_made_equal_as_data_exposure_says(film, tmp_path: Path):
    export(filmed(film), tmp_path / "film")
    module = RecordedDataModule(NerfstudioReader, tmp_path / "film")
    assert module.scene.dynamic.test.exposure_mask is not None
    plain = RecordedDataModule(NerfstudioReader, tmp_path / "film", exposure="none")
    assert plain.scene.dynamic.test.exposure_mask is None
    fewer = RecordedDataModule(NerfstudioReader, tmp_path / "film", frames=9)
    train, rest = fewer.scene.dynamic.train, fewer.scene.static.train
    assert (len(train), len(rest)) == (9, 18) and fewer.scene.dynamic.test.exposure_mask is not None
    among = [rest.names.index(name) for name in train.names]
    off = rest.pixels[among].float() - train.pixels.float()
    assert float(off.abs().max()) <= 1
    changed = module.scene.dynamic.train.pixels != plain.scene.dynamic.train.pixels
    assert float(changed.float().mean()) > 0.5
