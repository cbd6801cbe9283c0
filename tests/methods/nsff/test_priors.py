"""What images tell: neighbours, flow, depth, what moves; and what is missing."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
import torch

from devrf.data.rendered import RenderedDataModule
from devrf.engine.batches import gather_batch
from devrf.methods.nsff.fields import BACKWARD, FORWARD
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.priors import ImagePriors
from devrf.methods.nsff.settings import NSFFSettings, Warmup
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.scene import OpticalFlow, Scene, Views


def test_neighbours_are_of_the_same_view_and_numbered_through(tiny_scene: Scene) -> None:
    static, dynamic = tiny_scene.static.train, tiny_scene.dynamic.train
    priors = ImagePriors([static, dynamic], tiny_scene.space)
    assert len(priors.cameras) == 8 + 6
    # Static images, and both ends of the recording, are their own neighbours.
    assert priors.neighbour[:8].tolist() == [[k, k] for k in range(8)]
    assert priors.neighbour[8:].tolist() == [
        [10, 8], [11, 9], [12, 8], [13, 9], [12, 10], [13, 11],
    ]  # fmt: skip


def test_flow_is_looked_up_in_the_right_capture(tiny_scene: Scene) -> None:
    static, dynamic = tiny_scene.static.train, tiny_scene.dynamic.train
    size = (6, dynamic.height, dynamic.width)
    number = torch.arange(6.0)[:, None, None, None].expand(*size, 2).clone()
    forward = OpticalFlow(number, torch.ones(size, dtype=torch.bool))
    priors = ImagePriors([static, replace(dynamic, forward_flow=forward)], tiny_scene.space)
    image, flat = torch.tensor([5, 8, 13]), torch.tensor([3, 50, 431])
    batches = [
        gather_batch(views, image[own] - offset, flat[own], torch.ones(3))
        for views, own, offset in ((static, slice(0, 1), 0), (dynamic, slice(1, 3), 8))
    ]
    for batch, own in zip(batches, (slice(0, 1), slice(1, 3)), strict=True):
        batch = replace(batch, image=image[own])
        flow, valid = priors.flow(batch, FORWARD)
        assert valid.tolist() == [False, True, True][own]
        assert flow[:, 0].tolist() == [0.0, 0.0, 5.0][own]
        if batch.flow is not None:
            assert torch.equal(priors.flow(batch, BACKWARD)[0], batch.flow)
    assert priors.has_flow == (True, True) and priors.has_depth


@pytest.mark.parametrize("forward", [False, True])
def test_known_depth_is_a_distance_along_rays(
    tiny_scene: Scene, facing: Scene, forward: bool
) -> None:
    scene = facing if forward else tiny_scene
    views = scene.dynamic.train
    priors = ImagePriors([views], scene.space)
    flat = torch.arange(0, 24 * 18, 7)
    image = torch.ones_like(flat)
    batch = gather_batch(views, image, flat, torch.ones(3), scene.space)
    found = priors.distance(batch)
    assert views.depth is not None
    depth = views.depth[1].flatten()[flat]
    known = depth.isfinite()
    assert known.sum() > 5 and torch.equal(found.isfinite(), known)
    ray = torch.arange(len(flat))
    surface = scene.space.to_world(batch.rays.at(ray, found.nan_to_num(posinf=0.0)))[known]
    away = (surface - views.cameras.positions[image][known]).norm(dim=1)
    torch.testing.assert_close(away, depth[known], rtol=1e-3, atol=1e-3)


def test_pixels_that_move_are_those_of_fixed_cameras_with_long_flow(tiny_scene: Scene) -> None:
    views = tiny_scene.dynamic.train
    assert views.flow is not None
    priors = ImagePriors([tiny_scene.static.train, views], tiny_scene.space)
    long = (views.flow.vectors.norm(dim=-1) > 1) & views.flow.valid
    assert priors.moving is not None and len(priors.moving) == int(long.sum())
    assert bool((priors.moving.image >= 8).all())
    one_camera = replace(views, view=torch.arange(len(views)))
    assert ImagePriors([one_camera], tiny_scene.space).moving is None


def test_the_first_batches_have_rays_that_move(tiny: NSFFSettings, tiny_scene: Scene) -> None:
    model = NSFF(replace(tiny, warmup=Warmup(steps_per_frame=1, min_frames=3, max_frames=3)))
    model.setup(tiny_scene)
    generator = torch.Generator().manual_seed(0)
    assert model.further_pixels(generator) is None  # nothing has been looked at
    model.learn_from([tiny_scene.dynamic.train], ["color"])
    for step, expected in ((0, 4), (2, 4), (3, 0)):
        model.on_iteration(step, 10)
        found = model.further_pixels(generator)
        assert (0 if found is None else len(found[0])) == expected


def bare(views: Views) -> Views:
    """Images that tell nothing but colours."""
    return replace(views, flow=None, depth=None)


def test_what_is_missing_is_said_once_and_counts_nothing(
    tiny: NSFFSettings, tiny_scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    model, views = NSFF(tiny), bare(tiny_scene.dynamic.train)
    model.setup(tiny_scene)
    with caplog.at_level(logging.INFO):
        model.learn_from([views], model.losses)
    assert len(caplog.records) == 1
    assert "flow (no optical flow), depth (no depth), hard_rays (no motion masks)" in caplog.text
    batch = gather_batch(views, torch.tensor([1, 2]), torch.tensor([40, 80]), torch.ones(3))
    terms = model.loss_terms(model(batch), batch, model.losses)
    assert set(terms) == set(model.losses) - {"flow", "depth"}


def test_flow_in_one_direction_counts_alone(
    tiny: NSFFSettings, tiny_scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    model = NSFF(tiny)
    model.setup(tiny_scene)
    with caplog.at_level(logging.INFO):
        model.learn_from([tiny_scene.dynamic.train], model.losses)
    assert [r.message.rpartition(": ")[2] for r in caplog.records] == [
        "half of flow (no forward flow)"
    ]


def test_added_densities_have_no_terms_of_a_share(
    tiny: NSFFSettings, tiny_scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    model, views = NSFF(replace(tiny, blend="additive")), tiny_scene.dynamic.train
    model.setup(tiny_scene)
    with caplog.at_level(logging.INFO):
        model.learn_from([views], model.losses)
    assert "dynamic (no blend v), disocclusion (no blend v)" in caplog.text
    batch = gather_batch(views, torch.tensor([1, 2]), torch.tensor([40, 80]), torch.ones(3))
    terms = model.loss_terms(model(batch), batch, model.losses)
    assert set(terms) == set(model.losses) - {"dynamic", "disocclusion"}
    assert all(bool(value.isfinite()) for value in terms.values())


def test_an_embedded_scene_tells_flow_both_ways(tiny_recipe: ProceduralScene) -> None:
    module = RenderedDataModule(tiny_recipe, None)
    module.provide(NSFF.priors)
    assert ImagePriors([module.scene.dynamic.train], module.scene.space).has_flow == (True, True)
