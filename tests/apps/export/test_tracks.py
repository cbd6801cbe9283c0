"""What moves alone, in pictures and as geometry, and the ways of chosen points."""

from __future__ import annotations

import csv
import json

import pytest
import torch

from devrf.apps.export.geometry import ExportSettings
from devrf.apps.export.scene import export_scene
from devrf.apps.export.surface import surface_of
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.rendering.renderer import Renderer
from devrf.rendering.seen_points import scene_radius
from devrf.rendering.tracks import moving_pixels


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
        ({"format": "csv", "part": "still"}, r"^export\.part: expected all beside export\.tracks"),
        ({"format": "gltf", "content": "auto"}, r"^export\.format: expected csv, json or usd"),
    ):
        with pytest.raises(DevrfError, match=said):
            written(**wrong)
