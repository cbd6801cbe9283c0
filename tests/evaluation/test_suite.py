"""What is measured beside PSNR and SSIM: where each comes from, and when it is unknown."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from devrf.errors import DevrfError
from devrf.evaluation.held_out import score
from devrf.evaluation.scoring import score_held_out
from devrf.evaluation.suite import MEASURES, Evaluation, flow_error
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.model import DeVRFModel
from devrf.metrics.image import psnr_masked, ssim_masked
from devrf.metrics.lpips import TRUNKS, read_lpips
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.renderer import Renderer
from devrf.rendering.sampling import RenderSettings
from devrf.scenes.scene import OpticalFlow, Views

HOST = torch.device("cpu")
SIDE = 41


@pytest.fixture
def alex(tmp_path):
    """Some weights of the smaller network."""
    state = TRUNKS["alex"].build().state_dict()
    path = tmp_path / "alex.pth"
    torch.save({f"features.{name}": value for name, value in state.items()}, path)
    return path


def slab(box, settings, space=WORLD):
    """All of the box below z = −0.025, halfway between two grid points, is solid."""
    build = Architecture()
    field = build.search_field(box, SIDE**3)
    with torch.no_grad():
        field.density.values.fill_(-400.0)
        field.density.values[:, :, : SIDE // 2] = 400.0
    return DeVRFModel(build, field, Occupancy.full((SIDE,) * 3, box), settings, space=space)


def views(depth, z):
    """One 8×8 image taken at height z, looking down."""
    pose = torch.eye(3, 4)
    pose[2, 3] = z
    cameras = Cameras(pose[None], torch.full((1, 2), 40.0), torch.full((1, 2), 4.0), 8, 8)
    pixels = torch.full((1, 8, 8, 4), 255, dtype=torch.uint8)
    return Views(
        pixels, cameras, torch.zeros(1), torch.zeros(1, dtype=torch.long), ("a",), depth=depth
    )


def test_depth_of_a_slab_by_hand(cube):
    model = slab(cube, RenderSettings(step=0.1, alpha_threshold=1e-4, near=0.0, far=9.0))
    images = views(torch.zeros(1, 8, 8), z=3.975)
    # A ray meets the face after 4 / cos of its angle.
    truth = 4 / -images.cameras.image_rays(0).directions[:, 2].view(8, 8)
    assert float(truth.max() - truth.min()) > 0.01
    suite = Evaluation(metrics=["depth_error"]).suite(HOST)
    for off in (0.0, 0.25, -0.5):
        known = replace(images, depth=truth[None] + off)
        found = score(Renderer(model), known, 0, "black", suite).further["depth_error"]
        # A step is 0.005 long.
        assert found == pytest.approx(abs(off), abs=0.01)


def test_depth_of_a_scene_in_ndc_is_in_world_units():
    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    # The mirrored slab is solid from z' = 0.025 on: 1 + 2·near/z, so from z = −4 / 0.975 on.
    space = NormalizedDevice(8, 8, (40.0, 40.0), near=2.0)
    model = slab(box, RenderSettings(step=0.02, alpha_threshold=1e-4, near=0.0, far=1.0), space)
    with torch.no_grad():
        values = model.canonical.density.values
        values.copy_(values.flip(2))
    images = views(torch.zeros(1, 8, 8), z=0.0)
    truth = 4 / 0.975 / -images.cameras.image_rays(0).directions[:, 2].view(8, 8)
    images = replace(images, depth=truth[None] + 0.5)
    suite = Evaluation(metrics=["depth_error"]).suite(HOST)
    found = score(Renderer(model), images, 0, "black", suite).further["depth_error"]
    assert found == pytest.approx(0.5, abs=0.03)


def test_covisible_lpips_is_alexnets_of_images_that_are_black_elsewhere(rng, alex):
    mask = torch.zeros(40, 48, dtype=torch.bool)
    mask[8:20, 10:30] = True
    images = torch.rand(2, 40, 48, 3, generator=rng)
    lpips, measure = read_lpips("alex", alex), MEASURES["lpips_covisible"]
    given = {"prediction": images[0], "truth": images[1], "valid_mask": mask, "lpips": lpips}
    black = images * mask[..., None]
    assert measure(SimpleNamespace(**given)) == lpips(*black, mask) != lpips(*images, mask)
    for unknown in ({"valid_mask": None}, {"lpips": SimpleNamespace(trunk=TRUNKS["vgg"])}):
        assert measure(SimpleNamespace(**{**given, **unknown})) is None


def test_every_metric_of_a_learned_scene(learned, tiny_scene, alex):
    suite = Evaluation(lpips_network="alex", lpips_weights=alex).suite(HOST)
    held_out, model = tiny_scene.dynamic.test, learned[0].scene_model
    view = score(Renderer(model), held_out, 2, "white", suite)
    assert list(view.further) == list(MEASURES)
    assert list(view.scores)[:3] == ["psnr", "ssim", "rest_pose_psnr"]
    mask = held_out.pixels[2, ..., 3] > 127
    assert 0 < int(mask.sum()) < mask.numel()
    assert view.further["psnr_masked"] == psnr_masked(view.prediction, view.truth, mask)
    assert view.further["ssim_masked"] == ssim_masked(view.prediction, view.truth, mask)
    depth, flow = view.further["depth_error"], view.further["flow_error"]
    assert depth is not None and 0 < depth < 1
    assert flow is not None and 0 < flow < 20
    # 24×18 pixels: too few for five scales, and for the network.
    assert view.further["ms_ssim"] is None and view.further["lpips"] is None


def test_scores_at_rest_serve_the_same_views_in_motion(moving, tiny_scene) -> None:
    held_out = tiny_scene.dynamic.test
    alone = score_held_out(moving, {"dynamic": held_out}, "white")["dynamic"]
    both = score_held_out(moving, {"static": held_out, "dynamic": held_out}, "white")
    known = [view.scores for view in both["dynamic"]]
    assert known == [view.scores for view in alone]
    assert [view["rest_pose_psnr"] for view in known] == [view.psnr for view in both["static"]]
    assert any(view["psnr"] != view["rest_pose_psnr"] for view in known)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"metrics": ["lpisp"]}, "evaluation.metrics: no metric 'lpisp'"),
        ({"lpips_weights": "no.pth"}, "evaluation.lpips_weights: no file no.pth"),
        ({"motion_masks": "nowhere"}, "evaluation.motion_masks: no folder nowhere"),
        ({"motion_masks": __file__}, "evaluation.motion_masks: no folder "),
        ({"predictions": "nowhere"}, "evaluation.predictions: no folder nowhere"),
    ],
)
def test_mistakes_are_named(wrong, message):
    with pytest.raises(DevrfError, match=message):
        Evaluation(**wrong).check()


def test_a_moving_block_by_hand(block, filmed_from_above):
    # The face is 4 away, the lens has 40 px: 0.3 units along x are 3 px, and came from the left.
    views = filmed_from_above((-3.0, 1.0))
    assert flow_error(Renderer(block), views, 2) == pytest.approx(1.0, abs=0.015)
    # From rest to the first frame: 2 px.
    views = filmed_from_above((-2.0, 0.0))
    assert flow_error(Renderer(block), views, 1) == pytest.approx(0, abs=0.015)


def test_a_scene_without_motion_or_matter_shows_none(block, filmed_from_above):
    views = filmed_from_above((-3.0, 4.0))
    block.deformation = None
    assert flow_error(Renderer(block), views, 2) == pytest.approx(5.0, abs=1e-3)
    with torch.no_grad():
        block.canonical.density.values.fill_(-400.0)
    assert flow_error(Renderer(block), views, 2) == pytest.approx(5.0)


def test_flow_without_flow_or_an_earlier_frame_it_is_unknown(block, filmed_from_above):
    views, renderer = filmed_from_above((-3.0, 0.0)), Renderer(block)
    assert flow_error(renderer, views, 0) is None
    assert flow_error(renderer, replace(views, flow=None), 1) is None
    assert views.flow is not None
    nowhere = OpticalFlow(views.flow.vectors, torch.zeros_like(views.flow.valid))
    assert flow_error(renderer, replace(views, flow=nowhere), 1) is None
    # A method whose views have no motion.
    still: Any = SimpleNamespace(induced_flow=lambda *_: None)
    assert flow_error(still, views, 1) is None
