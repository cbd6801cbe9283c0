"""Datamodules: the batch that a stage asks for."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from devrf.data.priors import without_priors
from devrf.data.recorded import (
    READERS,
    ForwardFacingDataModule,
    InwardFacingDataModule,
    RecordedDataModule,
)
from devrf.data.rendered import ProceduralDataModule
from devrf.errors import DevrfError
from devrf.scenes.export import export
from devrf.scenes.procedural import ProceduralForwardScene


def test_the_scene_is_loaded_once_and_only_when_needed(tiny_scene, serve):
    module = serve(tiny_scene)
    assert module.loads == 0
    assert type(module).__name__ in str(module)  # which Lightning's would end in an error
    module.setup("fit")
    module.setup("test")
    assert module.scene is tiny_scene and module.loads == 1


def test_training_views_move_to_the_device_once_for_each_capture(tiny_scene, serve):
    module, cpu = serve(tiny_scene), torch.device("cpu")
    static = module.training_views("static", cpu)
    assert module.training_views("static", cpu) is static
    assert torch.equal(static.pixels, tiny_scene.static.train.pixels)
    dynamic = module.training_views("dynamic", cpu)
    assert torch.equal(dynamic.times, tiny_scene.dynamic.train.times)
    assert dynamic.flow is not None and len(dynamic) == 6


@pytest.mark.parametrize(
    ("names", "capture", "images", "scored", "held_out"),
    [
        (("static",), "static", (8,), "static", 2),
        (("static", "dynamic"), "both", (8, 6), "dynamic", 3),
        (("at_rest",), "static", (10,), "static", 2),
    ],
)
def test_a_stage_is_served_what_it_learns_from_and_what_scores_it(
    tiny_scene, serve, names, capture, images, scored, held_out
):
    module, cpu = serve(tiny_scene), torch.device("cpu")
    stage = SimpleNamespace(images=names, capture=capture)
    learner: Any = SimpleNamespace(lightning_module=stage)
    module.trainer = learner
    served = module.transfer_batch_to_device(None, cpu, 0)
    views = served if isinstance(served, tuple) else (served,)
    assert tuple(len(one) for one in views) == images
    assert all(one.frames is not None for one in views)
    assert module.scored_capture == scored and len(module.test_dataloader()) == held_out
    # Without a validation split the held-out views stand in for it.
    assert module.validation_views is module.test_views
    assert module.transfer_batch_to_device(1, cpu, 0) == 1


def test_the_first_frames_of_fixed_cameras_show_the_scene_at_rest(tiny_scene):
    static, moving = tiny_scene.static.train, tiny_scene.dynamic.train
    at_rest = tiny_scene.at_rest
    first = moving[(moving.times == 0).nonzero()[:, 0]]
    assert at_rest.names == static.names + first.names and len(first) == 2
    assert torch.equal(at_rest.pixels, torch.cat([static.pixels, first.pixels]))
    poses = [views.cameras.camera_to_world for views in (static, first)]
    assert torch.equal(at_rest.cameras.camera_to_world, torch.cat(poses))
    assert at_rest.frames is not None and not at_rest.frames.any()
    assert at_rest.valid_mask is None and at_rest.flow is None
    # Static views that are first frames of all cameras count once.
    same = replace(tiny_scene, static=replace(tiny_scene.static, train=first))
    assert same.at_rest.names == first.names


@pytest.mark.parametrize("case", ["size", "one camera", "masks"])
def test_first_frames_that_differ_are_left_out(tiny_scene, case):
    moving = tiny_scene.dynamic.train
    if case == "size":
        cameras = moving.cameras.resized(12, 9)
        moving = replace(moving, pixels=moving.pixels[:, ::2, ::2], cameras=cameras, flow=None)
    elif case == "one camera":
        moving = replace(moving, view=torch.arange(len(moving)))
    else:
        moving = replace(moving, valid_mask=moving.pixels[..., 0] > 0)
    scene = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=moving))
    assert scene.at_rest is scene.static.train


def test_the_training_loader_never_ends(tiny_scene, serve):
    loader = serve(tiny_scene).train_dataloader()
    assert list(itertools.islice(loader, 50)) == [None] * 50


def test_the_procedural_module_renders_what_it_was_told():
    module = ProceduralDataModule(
        "flower",
        width=12,
        height=8,
        static_views=3,
        static_test_views=2,
        train_views=2,
        frames=2,
        supersample=1,
    )
    scene = module.scene
    assert scene.name == "flower"
    assert scene.static.train.pixels.shape == (3, 8, 12, 4)
    assert len(scene.static.test) == 2 and len(scene.dynamic.train) == 4
    assert scene.clock.times == (0.0, 1.0)
    assert scene.dynamic.train.flow is not None


def test_an_embedded_scene_may_come_without_flow():
    numbers = {
        "width": 12,
        "height": 8,
        "static_views": 1,
        "static_test_views": 1,
        "train_views": 1,
    }
    module = ProceduralDataModule("robot", flow="none", frames=2, supersample=1, **numbers)
    assert module.scene.dynamic.train.flow is None
    module.provide({"forward_flow"})
    assert module.scene.dynamic.train.forward_flow is None
    with pytest.raises(DevrfError, match="data.flow: expected 'exact' or 'none', not 'dis'"):
        ProceduralDataModule("robot", flow="dis")


def test_options_are_checked_before_anything_is_read():
    inward = "'auto', 'files', 'dis', 'raft' or 'none'"
    with pytest.raises(DevrfError, match=f"data.flow: expected {inward}, not 'farneback'"):
        InwardFacingDataModule("nowhere", flow="farneback")
    with pytest.raises(DevrfError, match="data.flow: expected 'auto', 'dis', 'raft' or 'none'"):
        RecordedDataModule(READERS["nerfies"], "nowhere", flow="files")
    with pytest.raises(DevrfError, match="data.rot: no such option"):
        ForwardFacingDataModule("nowhere", rot=3)
    with pytest.raises(DevrfError, match="data.root: is missing"):
        InwardFacingDataModule()


@pytest.mark.parametrize("facing", ["inward", "forward"])
def test_a_scene_written_to_disk_is_read_with_its_flow(facing, tiny_scene, tmp_path):
    numbers = {"width": 24, "height": 16, "static_views": 7, "train_views": 2, "frames": 2}
    toy = ProceduralDataModule(recipe=ProceduralForwardScene, supersample=1, **numbers)
    scene = tiny_scene if facing == "inward" else toy.scene
    assert scene.kind == facing
    export(scene, tmp_path / "toy")
    module = InwardFacingDataModule if facing == "inward" else ForwardFacingDataModule
    read = module(tmp_path / "toy").scene
    ours, flow = scene.dynamic.train.flow, read.dynamic.train.flow
    assert read.name == "toy" and ours is not None and flow is not None
    assert torch.equal(flow.vectors, ours.vectors)
    bare = module(tmp_path / "toy", name="bare", flow="none").scene
    assert bare.name == "bare" and bare.dynamic.train.flow is None


def test_exact_forward_flow_undoes_backward_flow_once_it_is_asked_for(tiny_recipe):
    module = ProceduralDataModule(recipe=lambda: tiny_recipe)
    before = module.training_views("dynamic", torch.device("cpu"))
    assert before.forward_flow is None
    module.provide(("forward_flow",))
    views = module.training_views("dynamic", torch.device("cpu"))
    forward, backward, depth = views.forward_flow, views.flow, views.depth
    assert forward is not None and backward is not None and depth is not None
    # The last frame has none; what is seen in others has.
    assert not forward.valid[views.times == 1].any()
    assert torch.equal(forward.valid[:2], depth[:2].isfinite())
    # Two views of three frames: from image 0 to image 2 and back.
    place = forward.valid[0].nonzero()
    ends = place + forward.vectors[0][forward.valid[0]].flip(-1)
    column, row = ends[:, 1].round().long(), ends[:, 0].round().long()
    inside = (row >= 0) & (row < views.height) & (column >= 0) & (column < views.width)
    met = inside.nonzero()[:, 0][backward.valid[2][row[inside], column[inside]]]
    back = ends[met] + backward.vectors[2][row[met], column[met]].flip(-1)
    away = (back - place[met]).norm(dim=-1)
    assert len(met) > 20 and float(away.median()) < 1.0


@pytest.mark.parametrize("written", [True, False])
def test_forward_flow_is_read_from_files_else_estimated_beside_the_backward_one(
    tiny_scene, tmp_path, written
):
    folder = tmp_path / "scene"
    export(tiny_scene, folder)
    flows = next(folder.glob("dynamic_*views")) / "train_flow"
    if written:
        for path in flows.glob("*_bwd.npz"):
            number = int(path.name[:3]) - 2  # two views
            path.with_name(f"{number:03d}_fwd.npz").write_bytes(path.read_bytes())
    source = "auto" if written else "dis"
    module = InwardFacingDataModule(folder, flow=source, flow_cache=tmp_path / "flow.npz")
    assert module.scene.dynamic.train.forward_flow is None
    module.provide(("forward_flow",))
    views = module.scene.dynamic.train
    assert views.forward_flow is not None and views.flow is not None
    assert views.forward_flow.valid[0].any() and not views.forward_flow.valid[-1].any()
    same = torch.equal(views.forward_flow.vectors[0], views.flow.vectors[2])
    assert same == written
    assert (tmp_path / "flow_forward.npz").exists() != written


def test_without_priors_images_stand_before_the_background_and_tell_nothing_else(tiny_scene):
    train = tiny_scene.dynamic.train
    pixels = train.pixels.clone()
    pixels[0, 0, 0] = torch.tensor([255, 0, 100, 51])  # a fifth of it, on white
    known = replace(tiny_scene.dynamic, train=replace(train, pixels=pixels))
    scene = without_priors(replace(tiny_scene, dynamic=known))
    bare = scene.dynamic.train
    assert bare.pixels[0, 0, 0].tolist() == [255, 204, 224] and not bare.has_alpha
    assert bare.flow is bare.forward_flow is bare.depth is None
    assert scene.static.train.depth is None and scene.bounds.motion is None
    assert scene.dynamic.test.has_alpha
    assert scene.bounds.box == tiny_scene.bounds.box
