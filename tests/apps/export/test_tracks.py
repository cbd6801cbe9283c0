"""What moves alone, in pictures and as geometry, and the ways of chosen points."""

from __future__ import annotations

import csv
import json
from types import SimpleNamespace

import pytest
import torch

from devrf.apps.export.geometry import ExportSettings
from devrf.apps.export.scene import export_scene
from devrf.apps.export.surface import surface_of
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.geometry.clock import FrameClock
from devrf.geometry.space import WORLD
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.rendering.output import RenderedImage
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer
from devrf.rendering.seen_points import scene_radius
from devrf.rendering.tracks import moving_pixels
from devrf.scenes.procedural.filming import Filming, extent


@pytest.fixture(scope="module")
def two_balls(of_distance, cube):
    """Balls of radius 0.3 about x = 0.5 and x = -0.5; the second rises by 0.2 until t = 1."""
    middles = torch.tensor([[0.5, 0, 0], [-0.5, 0, 0]])
    model = of_distance(lambda points: torch.cdist(points, middles).amin(dim=1) - 0.3, cube, 31)
    deformation = DeformationField(cube, FrameClock((0.0, 1.0)), voxels=31**3)
    left = cube.grid_points(deformation.shape, torch.empty(0))[..., 0] < -0.01
    deformation.forward_slices[1, ..., 2] = 0.2 * left
    deformation.backward_slices[1, ..., 2] = -0.2 * left
    model.deformation = deformation
    return model


def viewpoints(around) -> Viewpoints:
    return Viewpoints("white", FrameClock((0.0, 1.0)), around, around, around[[0]])


def test_each_part_is_a_scene_of_its_own(two_balls, around):
    size = scene_radius(two_balls, around)
    assert 0.5 < size < 0.7  # as far are the balls' points from the middle between both
    for (name, part), side in zip(two_balls.moving_and_still(size).items(), (-1, 1), strict=True):
        assert name == ("moving" if side < 0 else "still")
        points = surface_of(part, part.surface(), around, ExportSettings(faces=500)).points
        assert points[:, 0].mul(side).amin() > 0.15 and points[:, 0].mul(side).amax() < 0.85
        # They share all but their density.
        assert part.canonical.color is two_balls.canonical.color
    assert not two_balls.moving_and_still(9 * size)  # 0.2 is less than a twentieth of it


def test_masks_show_the_points_that_move_at_any_time(two_balls, around):
    camera, size = around.single(4), scene_radius(two_balls, around)
    for time in (0.0, 1.0):
        mask = moving_pixels(Renderer(two_balls), camera, time, (0.0, 1.0), size)
        part = two_balls.moving_and_still(size)["moving"]
        shown = Renderer(part).view(camera, 0, time, 0.0).opacity.view(mask.shape) > 0.5
        assert 20 < int(mask.sum()) and int((mask != shown).sum()) <= 2


def test_tracks_by_hand(moving_ball, around, tmp_path):
    given = {"content": "tracks", "tracks": [[0.1, 0, 0.2], [0, -0.3, 0]], "seconds": 4.0}

    def written(**settings):
        settings = ExportSettings(**{**given, **settings})
        export_scene(moving_ball, viewpoints(around), settings, tmp_path)

    # It moves by 0.4 along x, and grows by a fifth.
    last = [[0.1 * 1.2 + 0.4, 0, 0.24], [0.4, -0.36, 0]]
    written(format="csv")
    with (tmp_path / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["track"], row["time"], row["seconds"]) for row in rows[-2:]] == [
        ("0", "1.0", "4.0"),
        ("1", "1.0", "4.0"),
    ]
    for row, place in zip(rows[-2:], last, strict=True):
        assert [float(row[axis]) for axis in "xyz"] == pytest.approx(place, abs=1e-5)
    written(format="json", times=[0.0, 1.0])
    tracks = json.loads((tmp_path / "tracks.json").read_text())["tracks"]
    assert [track["positions"][1] for track in tracks] == [
        pytest.approx(place, abs=1e-5) for place in last
    ]
    usd = pytest.importorskip("pxr.Usd", reason="the export extra is not installed")
    written(format="usd", up="y")
    stage = usd.Stage.Open(str(tmp_path / "tracks.usdc"))
    points = stage.GetPrimAtPath("/scene/tracks").GetAttribute("points")
    assert points.GetNumTimeSamples() == 2
    for point, place in zip(points.Get(4.0 * 24), last, strict=True):
        assert list(point) == pytest.approx(place, abs=1e-5)
    for wrong, said in (
        ({"format": "gltf"}, r"^export\.format: expected csv, json or usd"),
        ({"format": "csv", "tracks": None}, r"^export\.tracks: "),
        ({"format": "csv", "tracks": [[0, 0, torch.nan]]}, r"^export\.tracks.*: expected a finite"),
        ({"format": "csv", "content": "surface"}, r"^export\.content: expected tracks"),
        ({"format": "csv", "part": "still"}, r"^export\.part: expected all with tracks"),
        ({"format": "csv", "pixels": [[1, 1]]}, r"^export\.tracks: .*, or export\.pixels in place"),
        ({"format": "gltf", "content": "auto"}, r"^export\.format: expected csv, json or usd"),
    ):
        with pytest.raises(DevrfError, match=said):
            written(**wrong)


class Exact(Renderable):
    """An embedded scene itself, whose motion is exact, as if it had been learned."""

    name = "exact"

    def __init__(self, recipe):
        super().__init__()
        self.shape, reach = recipe.visible_shape(), extent(recipe.model()).reach
        self.filming = Filming(self.shape, reach, supersample=1)
        self.space, self.box, self.depth_limits = WORLD, recipe().bounds.box, (0.0, 9.0)

    device = torch.device("cpu")

    def config(self):
        return {}

    def at(self, time):
        def image(camera, background, crop):
            pixels, depth = self.filming.pictures(camera, time)
            met = depth.isfinite().float().flatten()
            color = pixels[0, ..., :3].reshape(-1, 3) / 255
            return RenderedImage(color, depth.nan_to_num(posinf=0.0).flatten(), met)

        return SimpleNamespace(at_rest=time == 0, image=image)

    def backward_warp(self, time):
        return lambda points: self.shape.material(points, time).canonical

    def forward_warp(self, time):
        return lambda points: self.shape.forward(self.shape.material(points, 0.0), time)


def test_what_a_pixel_shows_is_followed_as_an_embedded_scene_moves(
    tiny_recipe, tiny_scene, tmp_path
):
    """Of each pixel whose flow is known: it comes from where the exact flow says."""
    train = tiny_scene.dynamic.train
    image = 5  # of the second camera, the last of three
    assert (int(train.view[image]), float(train.times[image])) == (1, 1.0)
    row, column = train.flow.valid[image].nonzero().unbind(1)
    pixels = torch.stack([column, row], dim=1) + 0.5
    model, views = Exact(tiny_recipe), Viewpoints.of(tiny_scene)
    given = {"format": "json", "content": "tracks", "times": [0.0, 0.5, 1.0]}
    given |= {"pixels": pixels.tolist(), "pixels_view": "dynamic_1", "pixels_time": 1.0}
    export_scene(model, views, ExportSettings(**given), tmp_path)
    tracks = json.loads((tmp_path / "tracks.json").read_text())["tracks"]
    places = torch.tensor([track["positions"] for track in tracks])
    before, _ = train.cameras.project_into(image, places[:, 1])
    now, _ = train.cameras.project_into(image, places[:, 2])
    # Where two parts touch at rest, a place there does not say which of both it belongs to.
    clear = (now - pixels).norm(dim=1) < 1e-3
    vectors = train.flow.vectors[image][row, column]
    assert clear.float().mean() > 0.9 and vectors[clear].norm(dim=1).amax() > 1
    assert (before - pixels - vectors)[clear].norm(dim=1).amax() < 1e-3
    first = train.depth[image].isinf().nonzero()[0].flip(0).tolist()  # what sees nothing
    for wrong, said in (
        (
            {"pixels": [[24, 3]]},
            r"^export\.pixels: \[24, 3\] is outside of .* dynamic_1, of 24x18 px",
        ),
        ({"pixels": [[3, -0.5]]}, r"^export\.pixels: \[3, -0\.5\] is outside"),
        ({"pixels": [first]}, r"^export\.pixels: .* of dynamic_1 shows nothing at time 1; give"),
        (
            {"pixels_view": "dynamic_2"},
            r"^export\.pixels_view: no camera 'dynamic_2'; choose held_out, static_0 to static_7 "
            r"or dynamic_0 to dynamic_1$",
        ),
        ({"pixels_time": 1.5}, r"^export\.pixels_time: "),
        ({"pixels": [[1, 2, 3]]}, r"^export\.pixels"),
    ):
        with pytest.raises(DevrfError, match=said):
            export_scene(model, views, ExportSettings(**(given | wrong)), tmp_path)


def test_a_pixel_of_rays_has_the_depth_of_its_own_place(moving_ball, around, tmp_path):
    """Places in one pixel differ: the ball's side is met where each ray goes."""
    given = {"format": "json", "pixels_view": "static_0", "pixels_time": 0.0, "times": [0.0, 1.0]}
    middle = [[24.0, 18.0], [24.4, 18.0]]
    export_scene(moving_ball, viewpoints(around), ExportSettings(**given, pixels=middle), tmp_path)
    tracks = json.loads((tmp_path / "tracks.json").read_text())["tracks"]
    places = torch.tensor([track["positions"] for track in tracks])
    assert (places[1, 0] - places[0, 0]).norm() > 0.01
    torch.testing.assert_close(
        places[:, 1], places[:, 0] * 1.2 + torch.tensor([0.4, 0, 0]), atol=1e-4, rtol=0
    )
