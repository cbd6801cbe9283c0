"""What moves in held-out images, what is scored of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate, max_pool2d

from devrf.errors import DevrfError
from devrf.evaluation.motion import flicker, mostly_lost, pck_t, shifted, with_motion_masks
from devrf.evaluation.predictions import picture_name
from devrf.evaluation.suite import MEASURES
from devrf.geometry.motion import moving, radius
from devrf.pictures.images import write_image
from devrf.rendering.renderer import Renderer
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.procedural.filming import Filming
from devrf.scenes.procedural.rigs import dynamic_rig
from devrf.scenes.procedural.solids import Material
from devrf.scenes.scene import Views

WAY = torch.tensor([0.0, 0.3, 0.0])


@dataclass(frozen=True)
class TwoBalls:
    """One ball stands at x = 0.4; one at x = -0.4 goes along y by 0.3 until t = 1."""

    radius: float = 0.25

    def _centers(self, time: float) -> torch.Tensor:
        return torch.stack([torch.tensor([0.4, 0, 0]), torch.tensor([-0.4, 0, 0]) + time * WAY])

    def distance(self, points, time):
        return torch.cdist(points, self._centers(time)).amin(dim=1) - self.radius

    def material(self, points, time):
        part = torch.cdist(points, self._centers(time)).argmin(dim=1)
        return Material(points - part[:, None] * time * WAY, part)

    def forward(self, material, time):
        return material.canonical + material.part[:, None] * time * WAY

    def color(self, material):
        return torch.ones_like(material.canonical)


@pytest.fixture(scope="module")
def balls():
    train, test = dynamic_rig(2, (32, 24), reach=1.0)
    return Filming(TwoBalls(), 1.0, supersample=1).dynamic(train, test, frames=3)


def test_exact_masks_and_key_points_of_the_ball_that_moves(balls):
    for k in range(len(balls.test)):
        rays, depth = balls.test.cameras.image_rays(k), balls.test.depth[k].flatten()
        points = rays.at(torch.arange(len(rays)), depth.nan_to_num(posinf=9.0))
        expected = depth.isfinite() & (points[:, 0] < 0)
        assert 0 < int(expected.sum()) < int(depth.isfinite().sum())
        assert torch.equal(balls.test.motion_mask[k].flatten(), expected)
    shown = balls.keypoints[..., 2] > 0
    assert balls.keypoints.shape == (6, 32, 3) and shown[0].all() and not shown.all()
    at = balls.keypoints[..., :2] * torch.tensor([32.0, 24.0])
    rays = balls.train.cameras.rays(torch.zeros(32, dtype=torch.long), at[0])
    column, row = at[0].long().unbind(1)
    first = rays.at(torch.arange(32), balls.train.depth[0][row, column])
    last, _ = balls.train.cameras.project_into(4, first + WAY)
    torch.testing.assert_close(last, at[4])


def test_one_threshold_and_a_size_that_far_points_do_not_change():
    points = torch.tensor([[-1.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 9e9]])
    assert radius(points) == 1
    places = torch.zeros(3, 2, 3)
    places[1, :, 0] = torch.tensor([0.049, 0.051])  # they return
    assert moving(places, 1.0).tolist() == [False, True]


def made(pixels, times, view=None) -> Views:
    train, _ = dynamic_rig(1, (pixels.shape[2], pixels.shape[1]), reach=1.0)
    count = len(pixels)
    views = torch.zeros(count, dtype=torch.long) if view is None else view
    names = tuple(f"{k}.png" for k in range(count))
    return Views(pixels, train[torch.zeros(count, dtype=torch.long)], times, views, names)


def textured(height, width, rng) -> torch.Tensor:
    """A picture (H, W, 3) uint8 of blots of some pixels."""
    blots = torch.rand(1, 3, height // 4 + 1, width // 4 + 1, generator=rng)
    smooth = interpolate(blots, (height, width), mode="bilinear")[0]
    return (smooth.permute(1, 2, 0) * 255).to(torch.uint8)


def test_without_exact_motion_masks_are_given_or_are_what_flow_moves(tmp_path, rng):
    pixels = textured(48, 64, rng).repeat(4, 1, 1, 1)
    patch, expected = textured(20, 20, rng), torch.zeros(4, 48, 64, dtype=torch.bool)
    for k in range(4):
        where = k, slice(14, 34), slice(16 + 4 * k, 36 + 4 * k)
        pixels[where], expected[where] = patch, True
    views = made(pixels, torch.linspace(0, 1, 4))
    masked, rule = with_motion_masks(views, "white", None)
    mask = masked.motion_mask
    assert rule == "optical flow (DIS) longer than 0.025 radii"
    assert (mask & expected).sum() / (mask | expected).sum() > 0.6
    # It hardly reaches more than a few pixels beyond the patch.
    beside = max_pool2d(expected.float(), 11, 1, 5) == 0
    assert (mask & beside).sum() / mask.sum() < 0.1
    alpha = torch.where(expected, 255, 0).to(torch.uint8)[..., None]
    cut_out = shifted(replace(views, pixels=torch.cat([pixels, alpha], dim=3)), "white")
    assert (cut_out & expected).sum() / expected.sum() > 0.9 and not (cut_out & ~expected).any()
    # Neither what stands still moves, nor what a camera sees once.
    still = replace(views, pixels=pixels[:1].repeat(4, 1, 1, 1))
    alone = replace(views, view=torch.arange(4))
    assert with_motion_masks(still, "white", None) == (still, None)
    assert with_motion_masks(alone, "white", None) == (alone, None)
    for k in range(4):
        write_image(tmp_path / picture_name(views, k), torch.ones(48, 64, 3) * (k == 1))
    masked, rule = with_motion_masks(views, "white", tmp_path)
    assert masked.motion_mask.flatten(1).float().mean(dim=1).tolist() == [0, 1, 0, 0]
    assert rule == f"given: {tmp_path}"
    for file in tmp_path.iterdir():  # as labels
        iio.imwrite(file, (iio.imread(file) > 127).astype(np.uint8))
    labelled, _ = with_motion_masks(views, "white", tmp_path)
    assert torch.equal(labelled.motion_mask, masked.motion_mask) and masked.motion_mask.any()
    (tmp_path / picture_name(views, 2)).unlink()
    with pytest.raises(DevrfError, match=r"has no picture of 2\.png"):
        with_motion_masks(views, "white", tmp_path)


def test_what_flow_moves_is_what_moves_of_the_embedded_robot():
    views = ProceduralScene(
        shape="robot", static_views=1, static_test_views=1, train_views=1, frames=7, supersample=1
    )().dynamic.test
    mask = shifted(views, "white")
    assert (mask & views.motion_mask).sum() / (mask | views.motion_mask).sum() > 0.88
    # Who comes into view later moves as well.
    views.pixels[0] = 0
    assert shifted(views, "white")[1:].any()


@pytest.mark.parametrize("deviation", [3, 8])
def test_noise_does_not_move(rng, deviation):
    """Where nothing is to be seen, optical flow leads anywhere."""
    wall = torch.full((5, 200, 280, 3), 115.0)
    wall[:, :, 140:] += 40
    noisy = (wall + deviation * torch.randn(wall.shape, generator=rng)).to(torch.uint8)
    assert shifted(made(noisy, torch.linspace(0, 1, 5)), "white").float().mean() < 0.002


def test_the_radius_of_what_many_images_show_is_that_of_a_few(rng, monkeypatch):
    measured = []
    monkeypatch.setattr(
        "devrf.evaluation.motion.radius", lambda points: measured.append(points) or radius(points)
    )
    shifted(made(textured(32, 40, rng).repeat(20, 1, 1, 1), torch.linspace(0, 1, 20)), "white")
    assert [len(points) for points in measured] == [8 * 32 * 40]


def test_large_images_are_compared_smaller(rng):
    pixels = textured(1100, 1280, rng).repeat(2, 1, 1, 1)
    pixels[1, 400:700, 480:900] = pixels[0, 400:700, 440:860]
    mask = shifted(made(pixels, torch.tensor([0.0, 1.0])), "white")
    assert mask.shape == (2, 1100, 1280) and mask[1, 430:670, 510:870].float().mean() > 0.9
    assert not mask[:, :300].any() and not mask[:, 800:].any()


def test_only_pixels_of_the_mask_count(rng):
    mask = torch.zeros(40, 48, dtype=torch.bool)
    mask[20:, :] = True
    truth = torch.rand(40, 48, 3, generator=rng) / 2
    wrong = torch.where(mask[..., None], truth + 0.1, truth + 0.3)
    given = {"prediction": wrong, "truth": truth, "moving": mask, "lpips": None}
    assert MEASURES["psnr_moving"](SimpleNamespace(**given)) == pytest.approx(20, abs=1e-3)
    none = SimpleNamespace(**{**given, "moving": mask & False})
    assert MEASURES["psnr_moving"](none) is None and MEASURES["ssim_moving"](none) is None


def test_flicker_is_the_change_of_the_signed_error():
    pixels = torch.zeros(3, 12, 16, 3, dtype=torch.uint8)
    views = made(pixels, torch.tensor([0.0, 0.5, 1.0]))
    truth = torch.rand(12, 16, 3) / 2 + 0.2
    # Errors of one size; from the first to the second image half of them change their sign.
    first, second = torch.full((12, 16, 3), 0.1), torch.full((12, 16, 3), 0.1)
    second[:6] = -0.1
    errors = (first, second, second)
    scored = [SimpleNamespace(compared=truth + error, truth=truth) for error in errors]
    assert flicker(views, scored) == [None, pytest.approx(0.1), pytest.approx(0)]
    valid = torch.ones(3, 12, 16, dtype=torch.bool)
    valid[0, 6:] = False
    assert flicker(replace(views, valid_mask=valid), scored)[1] == pytest.approx(0.2)
    assert flicker(replace(views, view=torch.arange(3)), scored) == [None] * 3


def test_key_points_of_a_moving_block_by_hand(block, filmed_from_above):
    # The face is 4 away, the lens has 40 px: 0.2 units until t = 0.5 are 2 px, 0.5 are 5 px.
    views = filmed_from_above((0.0, 0.0))
    places = [[[1.0, 4, 1], [2, 2, 1]], [[3, 4, 1], [4, 2, 0]], [[6, 4, 1], [5, 2, 1]]]
    keypoints = torch.tensor(places) / torch.tensor([8.0, 8, 1])
    # Of the second point, which is hidden in the second image, 5 should be 7: 2 of 8 are wrong.
    capture = SimpleNamespace(train=views, keypoints=keypoints)
    assert pck_t(Renderer(block), capture) == pytest.approx(6 / 8)
    assert pck_t(Renderer(block), SimpleNamespace(train=views, keypoints=None)) is None


@pytest.mark.parametrize(
    ("at_rest", "motion", "pose", "lost"),
    [
        (40.0, 29.0, 20.0, True),
        (40.0, 31.0, 20.0, False),
        (40.0, 34.5, 35.0, False),  # hardly anything moves
        (None, 20.0, 20.0, False),
        (40.0, 20.0, None, False),  # of a method without a rest pose
    ],
)
def test_motion_that_is_nearer_to_the_rest_pose_is_mostly_lost(at_rest, motion, pose, lost):
    dynamic = {"psnr": motion, "rest_pose_psnr": pose}
    line = mostly_lost({"static": {"psnr": at_rest}, "dynamic": dynamic})
    expected = "much of the motion was not found: 29.0 dB, the rest pose 20.0, the scene at rest 40"
    assert (line or "").startswith(expected) if lost else line is None
    assert mostly_lost({"static": {"psnr": at_rest}}) is None
