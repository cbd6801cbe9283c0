"""The scene at rest, as Gaussians, is moved to where images show it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.kernels.trilinear import interpolate
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extensions import frame_start
from devrf.methods.devrf.extensions.frame_start import StartFromBest
from devrf.methods.devrf.extensions.splat_alignment import LONGEST, SmallImage, SplatAlignment
from devrf.scenes.scene import Scene, Views


def shown_by(views: Views, way: torch.Tensor) -> Views:
    """The views of a scene that has moved by ``way`` (3,): as if the cameras had moved with it."""
    pose = views.cameras.camera_to_world.clone()
    pose[:, :, 3] += way
    return replace(views, cameras=replace(views.cameras, camera_to_world=pose))


@pytest.mark.parametrize("way", [(0.0, 0.0, 0.0), (0.5, -0.3, 0.0)])  # an arm is 0.2 thick
def test_a_scene_that_has_moved_further_than_it_is_thick_is_found(rest, tiny_scene, way):
    views = tiny_scene.static.train
    alignment = SplatAlignment(rest.model, views, most=400)
    assert 100 < len(alignment.points) <= 400
    box = rest.model.box
    found = alignment.change(
        rest.model,
        shown_by(views, torch.tensor(way)),
        images=range(8),
        forward=torch.zeros(6, 6, 6, 3),
        box=box,
    )
    moved = interpolate(found, alignment.points, box)
    missed = (moved - torch.tensor(way)).norm(dim=1)
    pixel = views.cameras.pixel_size(torch.zeros(3))  # as large as an arm is thick
    assert missed.median() < pixel


def test_where_nothing_is_opaque_nothing_moves(rest, tiny_scene):
    rest.model.canonical.density.values.data.fill_(-100.0)
    alignment = SplatAlignment(rest.model, tiny_scene.static.train, most=400)
    still = torch.zeros(6, 6, 6, 3)
    views = tiny_scene.dynamic.train
    found = alignment.change(rest.model, views, images=[1, 4], forward=still, box=rest.model.box)
    assert len(alignment.points) == 0 and torch.equal(found, still)


def test_an_image_becomes_smaller_with_its_camera(tiny_scene):
    large = replace(
        tiny_scene.static.train,
        pixels=torch.full((8, 96, 128, 4), 255, dtype=torch.uint8),
        cameras=tiny_scene.static.train.cameras.resized(128, 96),
    )
    large.pixels[0, :48] = torch.tensor([255, 0, 0, 51], dtype=torch.uint8)
    image = SmallImage.of(large, 0, torch.device("cpu"))
    assert (image.camera.width, image.camera.height) == (LONGEST, 48)
    assert image.pixels.shape == (4, 48, LONGEST)
    torch.testing.assert_close(image.pixels[:, 0, 0], torch.tensor([0.2, 0.0, 0.0, 0.2]))
    torch.testing.assert_close(image.pixels[:, 47, 0], torch.ones(4))
    assert image.camera.focal[0, 0] == large.cameras.focal[0, 0] / 2


@pytest.fixture
def asked(monkeypatch) -> list[int]:
    """The frames for which Gaussians were asked, in order."""
    frames = []
    aligned = StartFromBest._aligned

    def noted(self, context, frame, start):
        frames.append(frame)
        return aligned(self, context, frame, start)

    monkeypatch.setattr(StartFromBest, "_aligned", noted)
    return frames


def without(scene: Scene, *, flow: bool, masks: bool) -> Scene:
    """The scene without optical flow or alpha, where these are False."""

    def left(views: Views) -> Views:
        pixels = views.pixels if masks else views.pixels[..., :3]
        return replace(views, pixels=pixels, flow=views.flow if flow else None)

    static, dynamic = scene.static.mapped(left), scene.dynamic.mapped(left)
    return replace(scene, static=static, dynamic=dynamic)


def test_a_far_start_is_taken(rest, tiny_scene, fit, serve):
    # Both moving frames are three pixels beside their place: more than a visit of one step moves.
    way = torch.tensor([0.5, 0.0, 0.0])
    scene = without(tiny_scene, flow=False, masks=True)
    views = scene.dynamic.train
    far = shown_by(views, way).cameras.camera_to_world
    pose = torch.where((views.times > 0)[:, None, None], far, views.cameras.camera_to_world)
    views = replace(views, cameras=replace(views.cameras, camera_to_world=pose))
    scene = replace(scene, dynamic=replace(scene.dynamic, train=views))
    found = {}
    for gaussians in (0, 400):
        start = StartFromBest(gaussians=gaussians)
        levels = DeformationSchedule([Level(8, 1)], rays=16)
        stage = DeformationStage(rest, levels, extensions={"frame_start": start})
        fit(stage, data=serve(scene))
        points = SplatAlignment(rest.model, scene.static.train, most=400).points
        moved = interpolate(stage.field.forward_slices[1], points, stage.field.box)
        found[gaussians] = float((moved - way).norm(dim=1).median())
    assert found[0] > 0.4 and found[400] < 0.2


@pytest.mark.parametrize(
    ("gaussians", "flow", "masks", "timed", "frames"),
    [
        (50, False, True, False, [1, 2]),
        (0, False, True, False, []),
        (50, True, True, False, []),
        (50, False, False, False, []),
        (50, False, True, True, []),
    ],
)
def test_each_frame_of_the_coarsest_level_has_such_a_candidate(
    gaussians, flow, masks, timed, frames, asked, rest, tiny_scene, fit, serve
):
    levels = DeformationSchedule([Level(4, 1), Level(6, 1)], rays=16)
    start = StartFromBest(rays=64, gaussians=gaussians)
    stage = DeformationStage(rest, levels, extensions={"frame_start": start})
    stage.batch_size.is_timed = timed
    fit(stage, data=serve(without(tiny_scene, flow=flow, masks=masks)))
    assert asked == frames
    assert bool(stage.field.forward_slices[1:].any())


@pytest.mark.parametrize(("enough", "frames"), [(0.0, [1, 2]), (1e6, [])])
def test_where_candidates_show_a_frame_well_enough_there_are_none(
    enough, frames, asked, rest, tiny_scene, fit, serve, monkeypatch
):
    monkeypatch.setattr(frame_start, "ENOUGH", enough)
    levels = DeformationSchedule([Level(4, 1), Level(6, 1)], rays=16)
    start = StartFromBest(levels=2, rays=64, gaussians=50)
    stage = DeformationStage(rest, levels, extensions={"frame_start": start})
    fit(stage, data=serve(without(tiny_scene, flow=False, masks=True)))
    assert asked == frames
