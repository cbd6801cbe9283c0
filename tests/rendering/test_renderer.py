"""A renderer renders what the model renders, in chunks that memory allows, whole or cropped."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD
from devrf.methods.devrf import model as module
from devrf.rendering.output import RenderedImage
from devrf.rendering.renderer import MIN_CHUNK, Renderer, in_chunks
from devrf.rendering.sampling import RenderSettings
from pictures import assert_same_picture, plain_picture

CPU = torch.device("cpu")
WHITE = torch.ones(3)
RED, BLUE = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1])
NEAR, FAR = 0.5, 10.0


@pytest.mark.parametrize("time", [0.0, 0.4, 0.55, 1.0])
def test_it_renders_what_the_model_renders(moving, tiny_scene, time):
    cameras = tiny_scene.dynamic.test.cameras
    seen = Renderer(moving).view(cameras, 1, time, 1.0)
    assert_same_picture(seen, plain_picture(moving, cameras.image_rays(1), time, WHITE))
    assert 20 < int((seen.opacity > 0.5).sum()) < 24 * 18 / 2
    assert not seen.color.requires_grad


def test_the_views_of_the_last_times_are_cached(moving, monkeypatch):
    looks: list[float] = []
    usual = module.deformed_occupancy
    monkeypatch.setattr(module, "deformed_occupancy", lambda *a: looks.append(1) or usual(*a))
    renderer = Renderer(moving, times=2)
    for time in (0.4, 0.7, 0.4, 0.7, 0.4):
        renderer.at(time)
    assert len(looks) == 2
    renderer.at(0.9)
    renderer.at(0.4)
    renderer.at(0.7)  # replaced by 0.9
    assert len(looks) == 4


def test_any_size_and_any_background(moving, tiny_scene):
    cameras = tiny_scene.dynamic.test.cameras.resized(60, 45)
    seen = Renderer(moving).view(cameras, 0, 1.0, torch.tensor([0.0, 1.0, 0.0]))
    assert seen.color.shape == (60 * 45, 3) and seen.depth.shape == (60 * 45,)
    empty = seen.opacity == 0
    assert empty.any()
    assert torch.equal(seen.color[empty][0], torch.tensor([0.0, 1.0, 0.0]))


def test_a_pixel_is_the_mean_of_the_rays_that_it_had_in_learning(moving, tiny_scene):
    cameras = tiny_scene.dynamic.test.cameras
    focal = float(cameras.focal[0, 0])
    moving.settings = replace(moving.settings, rays_per_pixel=2, focal=focal)
    seen = Renderer(moving).view(cameras, 0, 0.5, 1.0)
    twice = cameras.resized(2 * cameras.width, 2 * cameras.height).image_rays(0)
    fine = plain_picture(moving, twice, 0.5, WHITE)

    def means(values):
        squares = values.view(cameras.height, 2, cameras.width, 2, -1)
        return squares.mean(dim=(1, 3)).flatten(0, 1).squeeze(1)

    torch.testing.assert_close(seen.color, means(fine.color))
    torch.testing.assert_close(seen.opacity, means(fine.opacity))
    quarters = [
        values.view(cameras.height, 2, cameras.width, 2).permute(0, 2, 1, 3).reshape(-1, 4)
        for values in (fine.opacity, fine.depth)
    ]
    expected = quarters[1].gather(1, quarters[0].argmax(dim=1, keepdim=True))[:, 0]
    torch.testing.assert_close(seen.depth, expected)
    single = plain_picture(moving, cameras.image_rays(0), 0.5, WHITE)
    assert (single.color - seen.color).abs().max() > 0.05
    assert_same_picture(Renderer(moving, smooth=False).view(cameras, 0, 0.5, 1.0), single)


def test_a_larger_picture_has_one_ray_in_a_pixel():
    learned = RenderSettings(0.5, 1e-3, near=0.0, far=1.0, rays_per_pixel=2, focal=100.0)
    assert [learned.rays_at(focal) for focal in (50.0, 100.0, 199.0, 200.0)] == [4, 4, 4, 1]
    assert replace(learned, rays_per_pixel=1).rays_at(100.0) == 1


@pytest.fixture
def rays(rng):
    origins = torch.rand(1000, 3, generator=rng)
    return Rays(origins, origins, origins)


def test_rays_come_in_order(rays):
    threads = torch.get_num_threads()
    parts = in_chunks(lambda part: rays.origins[part], len(rays), 300, CPU)
    assert len(parts) >= 4 and max(map(len, parts)) <= 300
    assert torch.equal(torch.cat(parts), rays.origins)
    assert torch.get_num_threads() == threads
    assert [len(part) for part in in_chunks(lambda part: rays[part], 0, 300, CPU)] == [0]


@pytest.mark.parametrize(
    ("count", "chunk", "sizes"),
    [
        (1000, 20_000, [334, 334, 332]),
        (1000, 300, [256, 256, 256, 232]),
        (300, 20_000, [256, 44]),
        (2700, 500, [450] * 6),
    ],
)
def test_all_cores_get_as_many_chunks(rays, monkeypatch, count, chunk, sizes):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    monkeypatch.setattr(torch, "set_num_threads", lambda threads: None)
    lengths = in_chunks(lambda part: [part.stop - part.start], count, chunk, CPU)
    assert [length for (length,) in lengths] == sizes


@pytest.mark.parametrize(
    ("error", "sizes"),
    [
        (torch.OutOfMemoryError("CUDA out of memory."), [512, MIN_CHUNK]),
        (RuntimeError("ours"), [512]),
    ],
)
def test_errors_that_smaller_chunks_do_not_prevent(error, sizes):
    tried: list[int] = []

    def render(part):
        tried.append(part.stop - part.start)
        raise error

    with pytest.raises(type(error), match=str(error)):
        in_chunks(render, 512, 512, CPU)
    assert tried == sizes


def test_an_image_is_the_same_with_less_memory(rest, tiny_scene, monkeypatch, caplog):
    rays = tiny_scene.static.test.cameras.image_rays(0)
    rays = rays[torch.arange(len(rays)).repeat(2)]
    whole = Renderer(rest.model).picture(rays, 0.0, 1.0)
    usual, tried = module.render, []

    def render(some, *others, **named):
        tried.append(len(some))
        if len(some) > 450:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return usual(some, *others, **named)

    monkeypatch.setattr(module, "render", render)
    assert_same_picture(Renderer(rest.model).picture(rays, 0.0, 1.0), whole)
    assert tried == [864, 432, 432]
    assert caplog.messages[-1].startswith("out of memory: pictures are rendered 432 rays")


class Walls:
    """A red wall at x = 0.5 and a blue one at x = −0.5, seen along −x from NEAR to FAR."""

    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    depth_limits = NEAR, FAR
    device = CPU
    chunk, at_rest = 2, False

    def __init__(self, space=WORLD):
        self.space = space

    def at(self, time):
        return self

    def render(self, rays, background):
        color, depth = background.repeat(len(rays), 1), torch.zeros(len(rays))
        for wall, paint in ((-0.5, BLUE), (0.5, RED)):
            distance = (rays.origins[:, 0] - wall) / -rays.directions[:, 0]
            hit = (distance >= NEAR) & (distance <= FAR)
            color[hit], depth[hit] = paint, distance[hit]
        return RenderedImage(color, depth, (depth > 0).float())


class Frames:
    """Images alone: each pixel has the colour of its focal length and the background."""

    device = CPU
    at_rest = False

    def at(self, time):
        return self

    def image(self, camera, background, crop):
        assert len(camera) == 1 and crop == Walls.box
        pixels = camera.width * camera.height
        color = (camera.focal[0, 0] * background).expand(pixels, 3)
        return RenderedImage(color, torch.ones(pixels), torch.ones(pixels))


def test_a_method_without_rays_renders_whole_images():
    positions = torch.tensor([[3.0, 0, 0], [0, 3.0, 0]])
    cameras = Cameras.looking_at(positions, torch.zeros(2, 3), focal=1.0, width=4, height=3)
    cameras.focal[1] = 5.0
    seen = Renderer(Frames()).view(cameras, 1, 0.5, 0.1, Walls.box)
    assert seen.color.shape == (12, 3) and torch.equal(seen.color, torch.full((12, 3), 0.5))


def along(x):
    """Rays from (x, 0, 0) and (x, 5, 0), which passes the box by, along −x."""
    ahead = torch.tensor([[-1.0, 0, 0]]).repeat(2, 1)
    return Rays(torch.tensor([[x, 0.0, 0.0], [x, 5.0, 0.0]]), ahead, ahead)


@pytest.mark.parametrize("space", [WORLD, ContractedSpace((-1.0,) * 3, (1.0,) * 3)])
@pytest.mark.parametrize(
    ("low", "high", "color", "depth"),
    [
        (-1.0, 1.0, RED, 2.5),
        (-1.0, 0.0, BLUE, 3.5),  # the red wall is cut away before it
        (0.0, 1.0, RED, 2.5),
        (-0.3, 0.3, torch.ones(3), 0.0),  # between them; the blue one is behind the box
    ],
)
def test_what_is_outside_a_crop_is_left_out(space, low, high, color, depth):
    crop = Box((low, -1.0, -1.0), (high, 1.0, 1.0))
    seen = Renderer(Walls(space)).picture(along(3.0), 0.0, 1.0, crop)
    torch.testing.assert_close(seen.color[0], color)
    assert float(seen.depth[0]) == pytest.approx(depth)
    assert float(seen.opacity[0]) == (depth > 0)
    assert seen.color[1].tolist() == [1, 1, 1] and float(seen.opacity[1]) == 0


def test_a_distant_camera_is_cropped_to_the_box():
    renderer, rays = Renderer(Walls()), along(30.0)
    assert float(renderer.picture(rays, 0.0, 1.0).opacity[0]) == 0  # beyond the far limit
    box = renderer.reach(rays.origins[0])
    assert box == Walls.box
    seen = renderer.picture(rays, 0.0, 1.0, box)
    assert (float(seen.depth[0]), seen.color[0].tolist()) == (29.5, RED.tolist())
    assert renderer.reach(torch.tensor([3.0, 0, 0])) is None
