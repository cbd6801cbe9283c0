"""HyperNeRF's facts: Nerfies, and slices of a space of more dimensions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Literal

import pytest
import torch

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.batch import RayBatch
from devrf.engine.protocol import ProtocolStage
from devrf.errors import DevrfError
from devrf.methods.hypernerf.model import HyperNeRF, HyperNeRFSettings
from devrf.methods.nerfies.model import Nerfies, NerfiesSettings
from devrf.methods.ray_stage import RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

TINY = HyperNeRFSettings(
    width=8, depth=3, bands=2, direction_bands=1, sampling="occupancy", separate_coarse=False,
    steps=16, occupancy_side=8, code=3, warp_width=8, warp_depth=2, warp_bands=2, slicing_width=8,
    slicing_depth=2, slicing_bands=2, ambient_delay=0.0, ambient_window=0.25,
)  # fmt: skip
Slicing = Literal["surface", "plane"]
EITHER = pytest.mark.parametrize("slicing", ["surface", "plane"])


@EITHER
def test_with_ambient_space_shut_it_is_nerfies(
    slicing: Slicing, tiny_scene: Scene, some_rays: RayBatch
) -> None:
    hyper = HyperNeRF(replace(TINY, slicing=slicing))
    shared = {one.name: getattr(TINY, one.name) for one in fields(NerfiesSettings)}
    plain = Nerfies(NerfiesSettings(**shared))
    for model in (hyper, plain):
        model.setup(tiny_scene)
        model.eval()
    if slicing == "surface":
        torch.nn.init.normal_(hyper.slicing.output.weight)
    state = hyper.state_dict()
    plain.load_state_dict({name: state[name] for name in plain.state_dict()})
    expected = plain(some_rays).color
    torch.testing.assert_close(hyper(some_rays).color, expected, atol=1e-6, rtol=1e-6)
    hyper.opened.fill_(1)
    assert (hyper(some_rays).color - expected).abs().max() > 1e-4


def test_ambient_space_opens_after_a_delay() -> None:
    model = HyperNeRF(replace(TINY, ambient_delay=0.25, ambient_window=0.5))
    opened = []
    for step in (0, 25, 50, 75, 100):
        model.on_iteration(step, 100)
        opened.append(model.opened.item())
    assert opened == [0.0, 0.0, 0.5, 1.0, 1.0]


@pytest.mark.parametrize(("slicing", "same"), [("plane", True), ("surface", False)])
def test_a_plane_has_one_ambient_coordinate_a_frame_and_a_surface_one_a_point(
    slicing: Slicing, same: bool
) -> None:
    points, time = torch.rand(6, 3), torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    model = HyperNeRF(replace(TINY, slicing=slicing))
    model.opened.fill_(1)
    if slicing == "surface":
        torch.nn.init.normal_(model.slicing.output.weight)
    _, ambient = model.deform(points, time)
    assert ambient is not None and ambient.shape == (6, 4)
    assert torch.equal(ambient[0], ambient[1]) is same
    assert not torch.equal(ambient[0], ambient[3])


@pytest.mark.parametrize(("frozen", "slicing"), [("canonical", "surface"), ("canonical*", "plane")])
def test_two_stages_freeze_all_or_all_but_what_ambient_space_enters_by(
    frozen: str,
    slicing: Slicing,
    ray_stage: Callable[..., RayStage],
    fit: Callable[..., RayStage],
    stored: Callable[[RayStage], LoadedCheckpoint],
    tiny_scene: Scene,
) -> None:
    model = HyperNeRF(replace(TINY, slicing=slicing))
    deformation = [model.warp, model.slicing]
    begun = [p.detach().clone() for part in deformation for p in part.parameters()]
    rest = stored(fit(ray_stage(model, "canonical")))
    # Static images move nothing, and leave ambient space shut.
    assert slicing == "plane" or all(
        map(torch.equal, begun, (p for part in deformation for p in part.parameters()))
    )
    assert model.opened.item() == 0
    before = {k: v.clone() for k, v in rest.model.state_dict().items()}
    cameras = tiny_scene.dynamic.test.cameras
    at_rest = Renderer(rest.model).view(cameras, 1, 0.0, 1.0).color
    step = ProtocolStage("deformation", "dynamic", frozen=(frozen,), builds_on="canonical")
    second = fit(ray_stage(model, step, earlier=rest))
    after = second.scene_model.state_dict()
    changed = {k for k in before if not torch.equal(before[k], after[k])}
    columns = {k for k in before if k.startswith("canonical.trunk.beside.")}
    learned = {k for k in changed if k.startswith("canonical.")}
    assert learned == (columns if frozen == "canonical" else set())
    assert {"warp.velocity.bias", "codes.table.weight"} <= changed
    # The scene at time 0 stays as it is.
    assert torch.equal(Renderer(second.scene_model).view(cameras, 1, 0.0, 1.0).color, at_rest)
    assert set(second.result().metadata.records) == {"canonical", "deformation"}


def test_what_cannot_be_is_said() -> None:
    with pytest.raises(DevrfError, match=r"settings\.ambient: .* 0"):
        replace(TINY, ambient=0)
    with pytest.raises(DevrfError, match=r"settings\.ambient_window: .*0\.5.*0\.75"):
        replace(TINY, ambient_delay=0.5, ambient_window=0.75)
