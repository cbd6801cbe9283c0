"""Each problem is found on a scene that was made to have it, and none on a healthy one."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import interpolate

from devrf.apps.inspection.advice import advice_on
from devrf.scenes.bounds import box_from_cameras
from devrf.scenes.scene import OpticalFlow


@pytest.fixture(scope="module")
def healthy(tiny_recipe):
    """A robot in 24×18 pixels: 16 static views all around, 2 moving views of 3 frames."""
    return replace(tiny_recipe, static_views=16)()


def changed(name, change):
    """A scene with one of its sets of images changed: ``static.train``."""
    capture, part = name.split(".")

    def spoil(scene):
        sets = getattr(scene, capture)
        return replace(scene, **{capture: replace(sets, **{part: change(getattr(sets, part))})})

    return spoil


def ambiguous(views):
    return replace(views, ambiguous_orientation=torch.arange(len(views)) == 7)


def late(views):
    return replace(views, times=0.1 + 0.9 * views.times)


def rgb(views):
    return replace(views, pixels=views.pixels[..., :3])


def turned(degrees):
    """The fourth camera turned about its own up axis."""

    def change(views):
        poses = views.cameras.camera_to_world.clone()
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        poses[3, :, :3] @= torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return replace(views, cameras=replace(views.cameras, camera_to_world=poses))

    return change


def painted(image, channels, value):
    def change(views):
        pixels = views.pixels.clone()
        pixels[image, ..., channels] = torch.tensor(value, dtype=torch.uint8)
        return replace(views, pixels=pixels)

    return change


def where(test):
    return lambda views: views[test(views).nonzero()[:, 0]]


def flowing(change):
    def flowed(views):
        assert views.flow is not None
        return replace(views, flow=OpticalFlow(*change(views.flow.vectors, views.flow.valid)))

    return changed("dynamic.train", flowed)


def without_alpha(scene, box=None):
    for name in SETS:
        scene = changed(name, rgb)(scene)
    bounds = replace(scene.bounds, box=box or scene.bounds.box.scaled(0.9))
    return replace(scene, bounds=bounds)


def one_colour(scene):
    return changed(MOVING, painted(2, slice(3), [90, 90, 91]))(without_alpha(scene))


SETS = REST, REST_TEST, MOVING, _ = "static.train", "static.test", "dynamic.train", "dynamic.test"
PROBLEMS = [
    (changed(REST_TEST, where(lambda v: v.times < 0)), "static test", "no view"),
    (changed(REST, turned(180)), "static train 003", "looks away"),
    (changed(REST, turned(75)), "static train 003", "in the picture"),
    (changed(REST, where(lambda v: v.cameras.positions[:, 0] > 0)), "static training", "sector of"),
    (one_colour, "frame 001 view 0", "one colour"),
    (changed(REST, painted(5, slice(4), [90, 0, 91, 0])), "static train 005", "mask is empty"),
    (changed(REST, painted(5, slice(3, 4), [255])), "static train 005", "opaque all over"),
    (changed(REST, ambiguous), "static train 007", "EXIF orientation"),
    (changed(REST_TEST, rgb), "static test", "without alpha masks"),
    (changed(REST_TEST, painted(slice(None), slice(3, 4), [255])), "static test", "opaque"),
    (changed(MOVING, late), "dynamic training", "begins at time 0.1"),
    (
        changed(MOVING, where(lambda v: (v.times != 0.5) | (v.view != 1))),
        "dynamic training",
        "time 0.5 without view 1",
    ),
    (flowing(lambda vectors, valid: (vectors, valid & False)), "optical flow", "on 0.0 %"),
    (flowing(lambda vectors, valid: (vectors + 25, valid)), "flow of", "the image (24 px)"),
    (flowing(lambda vectors, valid: (vectors * math.nan, valid)), "flow of", "not a number"),
]


@pytest.mark.parametrize(("spoil", "where", "what"), PROBLEMS)
def test_a_problem(healthy, spoil, where, what):
    (advice,) = advice_on(spoil(healthy))
    assert where in advice.where and what in advice.problem


def test_held_out_views_that_are_learned_from(healthy):
    train = healthy.dynamic.train
    spoil = changed("dynamic.test", lambda _: train[torch.tensor([0, 4])])
    (advice,) = advice_on(spoil(healthy))
    assert advice.where == "dynamic test set"
    assert train.names[0] in advice.problem and train.names[4] in advice.problem
    # The same camera at another time may be held out.
    test = replace(train[torch.tensor([0])], times=torch.tensor([0.25]))
    assert advice_on(changed("dynamic.test", lambda _: test)(healthy)) == []


def test_a_box_that_is_only_guessed(healthy):
    guess = box_from_cameras(healthy.static.train.cameras)
    (advice,) = advice_on(without_alpha(healthy, guess))
    assert "data.box=" in advice.remedy
    assert advice_on(without_alpha(healthy, guess.scaled(0.9))) == []


@pytest.mark.parametrize(("pixels", "far"), [(1, False), (9, True)])
def test_large_motion_without_flow_is_said(healthy, pixels, far):
    train = healthy.dynamic.train
    noise = torch.rand(1, 3, 96, 96, generator=torch.Generator().manual_seed(0))
    texture = interpolate(interpolate(noise, size=24, mode="area"), size=96, mode="bicubic")
    texture = (255 * texture[0].clamp(0, 1)).byte().permute(1, 2, 0)
    frames = train.frames * pixels
    images = torch.stack([texture.roll(int(step), dims=1) for step in frames])
    moving = replace(train, pixels=images, flow=None)
    scene = replace(healthy, dynamic=replace(healthy.dynamic, train=moving))
    said = [advice for advice in advice_on(scene) if advice.where == "optical flow"]
    assert [f"{pixels} px" in advice.problem for advice in said] == [True] * far


def test_fixed_cameras_that_face_another_place_than_the_static_ones(tiny_toy):
    def moved(views):
        poses = views.cameras.camera_to_world.clone()
        poses[..., 2, 3] += 3.1
        return replace(views, cameras=replace(views.cameras, camera_to_world=poses))

    def found(scene):
        return [str(advice) for advice in advice_on(scene) if "another world" in advice.problem]

    assert not found(tiny_toy)
    (line,) = found(replace(tiny_toy, dynamic=tiny_toy.dynamic.mapped(moved)))
    assert line.startswith(", ".join(tiny_toy.dynamic.train.names[:3]))
