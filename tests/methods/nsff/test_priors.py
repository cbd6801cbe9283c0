"""What images tell: neighbours, flow, depth, what moves; and what is missing."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
import torch

from devrf.data.rendered import ProceduralDataModule
from devrf.methods.batch import gather_batch
from devrf.methods.nsff.fields import BACKWARD, FORWARD
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.priors import ImagePriors
from devrf.methods.nsff.settings import NSFFSettings
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


def test_smaller_batches_have_fewer_pixels_that_move(tiny: NSFFSettings, tiny_scene: Scene) -> None:
    model = NSFF(tiny)
    model.setup(tiny_scene)
    model.prepare_priors([tiny_scene.dynamic.train], model.losses)
    model.on_iteration(0, 100)
    for share, count in ((1.0, 4), (0.5, 2), (1 / 64, 1)):
        further = model.extra_pixels(torch.Generator(), share)
        assert further is not None and len(further[0]) == count


def missing(caplog: pytest.LogCaptureFixture, model: NSFF, views: Views, scene: Scene) -> str:
    """What a model says that images do not have, and the terms that are left."""
    model.setup(scene)
    with caplog.at_level(logging.INFO):
        model.prepare_priors([views], model.losses)
    (record,) = caplog.records
    return record.getMessage().rpartition(": ")[2]


def terms(model: NSFF, views: Views) -> dict[str, torch.Tensor]:
    """The terms of two rays."""
    batch = gather_batch(views, torch.tensor([1, 2]), torch.tensor([40, 80]), torch.ones(3))
    return model.loss_terms(model(batch), batch, model.losses)


def test_what_is_missing_is_said_once_and_counts_nothing(
    tiny: NSFFSettings, tiny_scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    model, bare = NSFF(tiny), replace(tiny_scene.dynamic.train, flow=None, depth=None)
    said = missing(caplog, model, bare, tiny_scene)
    assert [name in said for name in ("flow", "depth", "hard_rays")] == [True] * 3
    assert set(terms(model, bare)) == set(model.losses) - {"flow", "depth"}


def test_flow_in_one_direction_counts_alone_and_added_densities_have_no_terms_of_a_share(
    tiny: NSFFSettings, tiny_scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    model, views = NSFF(replace(tiny, blend="additive")), tiny_scene.dynamic.train
    said = missing(caplog, model, views, tiny_scene)
    assert [name in said for name in ("dynamic", "disocclusion", "half of flow")] == [True] * 3
    left = terms(model, views)
    assert set(left) == set(model.losses) - {"dynamic", "disocclusion"}
    assert all(bool(value.isfinite()) for value in left.values())


def test_an_embedded_scene_tells_flow_both_ways(tiny_recipe: ProceduralScene) -> None:
    module = ProceduralDataModule(recipe=lambda: tiny_recipe)
    module.provide(NSFF.priors)
    assert ImagePriors([module.scene.dynamic.train], module.scene.space).has_flow == (True, True)
