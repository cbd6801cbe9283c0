"""A cloud of Gaussians: where it begins, what is pruned, cloned and split."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.methods.gaussians import cloud as cloud_module
from devrf.methods.gaussians.cloud import (
    NEIGHBOURS,
    RESET,
    Cloud,
    first_points,
    hull_surface,
    median_colors,
    nearest,
    neighbour_distances,
)
from devrf.methods.gaussians.settings import GaussiansSettings
from devrf.scenes.scene import Scene

RULE = GaussiansSettings(densify_above=0.1, max_points=100)
EXTENT = 10.0  # one that is larger than 0.1 is split


def logit(share: float) -> float:
    return math.log(share / (1 - share))


@pytest.fixture
def cloud() -> Cloud:
    """Four: a small one, a large one, a faint one, and one that wants nothing."""
    cloud = Cloud(degree=1)
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    cloud.begin(points, torch.full((4, 3), 0.7), torch.tensor([0.05, 0.4, 0.05, 0.05]), 0.5)
    cloud.opacity.data[2] = logit(0.004)
    for _ in range(2):  # the last is seen once
        cloud.note(torch.tensor([[0.3, 0.4], [0.0, 0.2], [3.0, 4.0], [0.0, 0.0]]))
    cloud.note(torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.03, 0.04]]))
    return cloud


def test_slopes_are_averaged_over_the_images_that_showed_one(cloud: Cloud) -> None:
    mean = cloud.seen[:, 0] / cloud.seen[:, 1]
    assert mean.tolist() == pytest.approx([0.5, 0.2, 5.0, 0.05])


def test_faint_ones_go_small_ones_are_cloned_and_large_ones_split(cloud: Cloud) -> None:
    sources = cloud.grow(RULE, EXTENT, reset=False)
    # Of rows 0, 1 and 3 as they were, then copies of 0 and 1, the longest slope first.
    assert len(cloud) == 5 and not cloud.seen.any() and int(cloud.grown) == 1
    for source in sources.values():
        assert source.tolist() == [0, -1, 3, -1, -1]
    x = cloud.means[:, 0].tolist()
    assert (x[0], x[2], x[3]) == (0.0, 3.0, 0.0)
    halves = cloud.means[[1, 4]]
    assert not torch.equal(halves[0], halves[1]) and (halves - halves.new_tensor([1.0, 0, 0])).any()
    size = cloud.scales.exp()[:, 0].tolist()
    assert size == pytest.approx([0.05, 0.25, 0.05, 0.05, 0.25])
    assert cloud.color.shape == (5, 3) and cloud.harmonics.shape == (5, 3, 3)


def test_the_cap_takes_those_that_want_most_and_a_reset_makes_all_faint(cloud: Cloud) -> None:
    rule = GaussiansSettings(densify_above=0.0, max_points=4)
    sources = cloud.grow(rule, EXTENT, reset=True)
    assert len(cloud) == 4 and sources["means"].tolist() == [0, 1, 3, -1]
    assert cloud.opacity.sigmoid().tolist() == pytest.approx([RESET] * 4)
    assert sources["opacity"].tolist() == [-1] * 4


def test_large_ones_go_after_the_first_reset(cloud: Cloud) -> None:
    rule = GaussiansSettings(densify_above=9.0, prune_above=0.01, densify_every=0.05)
    cloud.grow(rule, EXTENT, reset=False)
    assert len(cloud) == 3
    cloud.grow(rule, EXTENT, reset=False)  # 0.1 of the stage: a reset has been at 0.075
    assert cloud.means[:, 0].tolist() == [0.0, 3.0]


def test_two_processes_split_alike(cloud: Cloud) -> None:
    other = Cloud(degree=1)
    other.load_state_dict(cloud.state_dict())
    torch.manual_seed(1)
    cloud.grow(RULE, EXTENT, reset=False)
    torch.manual_seed(2)
    other.grow(RULE, EXTENT, reset=False)
    assert torch.equal(cloud.means, other.means)


def test_processes_count_what_each_has_seen(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = torch.tensor([[0.0, 0.0], [0.6, 1.0], [0.0, 0.0], [0.2, 1.0]])
    monkeypatch.setattr(cloud_module, "world_size", lambda: 2)
    monkeypatch.setattr(cloud_module, "average", lambda seen: (seen + elsewhere) / 2)
    cloud.seen.zero_()
    cloud.note(torch.tensor([[0.3, 0.4], [0.0, 0.2], [0.0, 0.0], [0.0, 0.0]]))
    # A file has all of it, from which all of them go on.
    expected = torch.tensor([[0.5, 1.0], [0.8, 2.0], [0.0, 0.0], [0.2, 1.0]])
    torch.testing.assert_close(cloud.seen, expected)


def test_neighbours_are_the_nearest_at_the_last_growth() -> None:
    cloud = Cloud(degree=0, embedding=2)
    points = torch.arange(20.0)[:, None].square().repeat(1, 3)
    cloud.begin(points, points, torch.ones(20), 0.5)
    assert sorted(cloud.neighbours[10].tolist()) == [6, 7, 8, 9, 11, 12]
    assert cloud.neighbours.shape == (20, NEIGHBOURS)
    with torch.no_grad():
        cloud.embedding[:] = torch.arange(20.0)[:, None]
        cloud.means[0] = points[10] + 0.1
    sources = cloud.grow(GaussiansSettings(densify_above=9.0), EXTENT, reset=False)
    assert sources["embedding"].tolist() == [*range(20)] and 0 in cloud.neighbours[10]
    assert torch.equal(cloud.embedding[:, 0], torch.arange(20.0))
    cloud.begin(points[:3], points[:3], torch.ones(3), 0.5)
    assert [set(row) for row in cloud.neighbours.tolist()] == [{1, 2}, {0, 2}, {0, 1}]


def test_it_begins_on_the_hull_with_the_colors_of_the_images(tiny_scene: Scene) -> None:
    settings = GaussiansSettings(hull_side=24, start_points=150, start_size=0.5)
    points, colors, sizes = first_points(tiny_scene, settings)
    assert points.shape == colors.shape == (150, 3) and sizes.shape == (150,)
    views, box = tiny_scene.at_rest, tiny_scene.bounds.box
    surface = hull_surface(views, box, 24)
    assert len(surface) > 150
    anywhere, _, _ = first_points(tiny_scene, GaussiansSettings(start_points=150))
    whole = tiny_scene.bounds.whole
    assert whole.contains(anywhere).all()
    # Of pixels on which they fall, those of the silhouettes: a grid's cell is two pixels.
    shares = []
    for some in (points, anywhere):
        seen = [views.cameras.project_into(k, some)[0].long() for k in range(len(views))]
        last = torch.tensor([views.width, views.height]) - 1
        columns = [pixel.clamp(min=0).minimum(last).unbind(1) for pixel in seen]
        inside = [views.pixels[k, y, x, 3] > 0 for k, (x, y) in enumerate(columns)]
        shares.append(float(torch.stack(inside).float().mean()))
    assert shares[0] > 1.5 * shares[1]
    assert colors.std(dim=0).min() > 0.02  # not grey alone


def test_points_that_no_image_shows_are_grey(tiny_scene: Scene) -> None:
    far = torch.tensor([[1e3, 0.0, 0.0]])
    assert median_colors(far, tiny_scene.at_rest).tolist() == [[0.5] * 3]


def test_distances_from_neighbours() -> None:
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    expected = [1.0] + [(1 + 2 * math.sqrt(2)) / 3] * 3
    assert neighbour_distances(corners).tolist() == pytest.approx(expected)
    assert neighbour_distances(corners[:1]).tolist() == [1.0]


def test_the_nearest_are_those_of_all_distances() -> None:
    points = torch.randn(3000, 3, generator=torch.Generator().manual_seed(0))
    points[:40] *= 30
    points[100:120] = points[99]  # more in one place than are asked for
    distances, rows = nearest(points, 6)
    apart = (points[:, None] - points).norm(dim=2)
    torch.testing.assert_close(apart.gather(1, rows), distances)
    expected = apart.fill_diagonal_(torch.inf).topk(6, largest=False).values
    torch.testing.assert_close(distances, expected)
    assert (rows != torch.arange(3000)[:, None]).all()


@pytest.mark.parametrize("lost", [torch.nan, torch.inf, -3e38])
def test_a_point_that_is_nowhere_has_neighbours_that_there_are(lost: float) -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    points[7] = lost
    distances, rows = nearest(points, 6)
    assert distances.isfinite().all() and ((rows >= 0) & (rows < 50)).all()


def test_distances_are_right_far_from_the_origin() -> None:
    points = 1024 + torch.rand(60, 3)
    expected = torch.stack([(points - point).norm(dim=1).sort().values[1:4] for point in points])
    torch.testing.assert_close(neighbour_distances(points), expected.mean(dim=1))
