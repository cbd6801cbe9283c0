"""Splats: Gaussians on the surface, as 3D Gaussian Splatting's viewers read them."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from pxr import Gf, Usd, UsdGeom, UsdVol

from devrf.apps.export.geometry import ExportSettings, MovingMesh, UpFrame, carried
from devrf.apps.export.scene import export_scene
from devrf.apps.export.splats import (
    DOWN,
    HARMONIC,
    MovingGaussians,
    write_splats,
    write_usd_splats,
)
from devrf.apps.export.surface import surface_of
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.methods.gaussians.model import DeformableGaussians
from devrf.methods.gaussians.settings import GaussiansSettings
from devrf.ops.splatting import Gaussians, rotations, splat

HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {}\n"
    "property float x\nproperty float y\nproperty float z\n"
    "property float nx\nproperty float ny\nproperty float nz\n"
    "property float f_dc_0\nproperty float f_dc_1\nproperty float f_dc_2\nproperty float opacity\n"
    "property float scale_0\nproperty float scale_1\nproperty float scale_2\n"
    "property float rot_0\nproperty float rot_1\nproperty float rot_2\nproperty float rot_3\n"
    "end_header\n"
)


def read(folder, number):
    """The numbers (V, 17) of a frame."""
    content = (folder / f"frame{number:04d}.ply").read_bytes()
    header, end, values = content.partition(b"end_header\n")
    rows = np.frombuffer(values, "<f4").reshape(-1, 17)
    assert (header + end).decode() == HEADER.format(len(rows))
    return rows


def thin_axes(rows):
    """(V, 3) the axis z turned by each quaternion."""
    w, x, y, z = rows[:, 13:].T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


def test_a_triangle_by_hand(tmp_path):
    # Of area 2, in the plane of x and y, seen from +z; then it is lifted by 1.
    corners = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    lifted = corners + torch.tensor([0.0, 0.0, 1.0])
    colors = torch.tensor([[0.5, 1.0, 0.0]]).expand(3, 3)
    vertices = torch.stack([corners, lifted])
    mesh = MovingMesh((0.0, 1.0), vertices, torch.tensor([[0, 1, 2]]), colors)
    path = tmp_path / "splats"
    write_splats(path, MovingGaussians.on_surface(mesh), {}, UpFrame(torch.eye(3), 1.0, "y"), 3.0)
    first = read(path, 1)
    assert first[:, :3].tolist() == [[0, 0, 0], [2, 0, 0], [0, -2, 0]]  # y is down
    np.testing.assert_array_equal(first[:, 3:6], 0)
    # Y_0 = 0.28209479; a third of 2 is a square of the edge 0.8165, of which 0.65; logit(0.95).
    np.testing.assert_allclose(first[:, 6:9], [[0, 1.7724539, -1.7724539]] * 3, rtol=1e-5)
    np.testing.assert_allclose(first[:, 9], 2.944439, rtol=1e-5)
    np.testing.assert_allclose(np.exp(first[:, 10:13]), [[0.530723, 0.530723, 0.0530723]] * 3, 1e-5)
    np.testing.assert_allclose(thin_axes(first), [[0, 0, -1]] * 3, atol=1e-6)
    np.testing.assert_allclose(read(path, 2)[:, 2], -1)
    index = json.loads((path / "index.json").read_text())
    assert index["frames"][1] == {"file": "frame0002.ply", "time": 1.0, "seconds": 3.0}
    assert "origin" not in index
    far = UpFrame(torch.eye(3), 2.0, "y", (500_000.0, 5_600_000.0, 200.0))
    one = MovingMesh((0.0,), vertices[:1], mesh.faces, colors)
    write_splats(path, MovingGaussians.on_surface(one), {}, far, 3.0)
    index = json.loads((path / "index.json").read_text())
    assert index["origin"] == [1_000_000, -11_200_000, -400]
    assert [file.name for file in path.glob("*.ply")] == ["frame0001.ply"]


def test_gaussians_go_with_the_field_and_lie_in_the_surface(moving_ball, around, tmp_path):
    surface = surface_of(moving_ball, moving_ball.surface(), around, ExportSettings(faces=800))
    mesh = carried(surface, moving_ball, (0.0, 1.0))
    path = tmp_path / "splats"
    write_splats(path, MovingGaussians.on_surface(mesh), {}, UpFrame.of(around, "auto", 1.0), 3.0)
    rest, moved = read(path, 1), read(path, 2)
    assert np.linalg.norm(rest[:, :3], axis=1) == pytest.approx(0.5, abs=0.02)
    # The ball grows by a fifth and moves by 0.4 along x.
    np.testing.assert_allclose(moved[:, :3], 1.2 * rest[:, :3] + [0.4, 0, 0], atol=1e-4)
    # The thin axis is the normal, which leads away from the middle.
    turned = thin_axes(rest)
    assert ((turned * rest[:, :3]).sum(axis=1) / 0.5).min() > math.cos(math.radians(25))


def test_usd_holds_the_same_gaussians_at_each_time(moving_ball, around, tmp_path):
    surface = surface_of(moving_ball, moving_ball.surface(), around, ExportSettings(faces=300))
    mesh = carried(surface, moving_ball, (0.0, 0.5, 1.0))
    frame = UpFrame.of(around, "auto", 1.0)
    path = tmp_path / "splats.usdc"
    moving = MovingGaussians.on_surface(mesh)
    write_usd_splats(path, moving, {"front": around.single(0)}, frame, 2.0)
    stage = Usd.Stage.Open(str(path))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/scene/splats"))
    assert field.GetPositionsAttr().GetTimeSamples() == [0, 24, 48]
    write_splats(tmp_path / "splats", moving, {}, frame, 2.0)
    for number, code in enumerate((0, 24, 48), start=1):
        rows = read(tmp_path / "splats", number)
        points = np.array(field.GetPositionsAttr().Get(code))
        np.testing.assert_allclose(points * [1, -1, -1], rows[:, :3], atol=1e-6)
        scales = np.array(field.GetScalesAttr().Get(code))
        np.testing.assert_allclose(scales, np.exp(rows[:, 10:13]), rtol=1e-5)
        # +z turned by the quaternion leads away from the ball's middle: out of the surface.
        turns = field.GetOrientationsAttr().Get(code)
        normals = np.array([turn.Transform(Gf.Vec3f(0, 0, 1)) for turn in turns])
        np.testing.assert_allclose(normals * [1, -1, -1], thin_axes(rows), atol=1e-5)
    np.testing.assert_allclose(np.array(field.GetOpacitiesAttr().Get()), 0.95, rtol=1e-6)
    factors = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    np.testing.assert_allclose(factors, rows[:, 6:9], atol=1e-6)
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 0
    assert stage.GetPrimAtPath("/scene/cameras/front").IsA(UsdGeom.Camera)


def test_a_format_of_surfaces_is_refused_for_gaussians_by_what_takes_them(tiny_scene, tmp_path):
    model = DeformableGaussians(GaussiansSettings(width=8, depth=1))
    views = Viewpoints.of(tiny_scene)
    for settings in (ExportSettings(), ExportSettings(format="usd")):
        with pytest.raises(DevrfError, match="has Gaussians, and no surface .*=splats, export.f"):
            export_scene(model, views, settings, tmp_path)
    with pytest.raises(DevrfError, match="has no surface; give export.format=splats$"):
        export_scene(model, views, ExportSettings(content="surface"), tmp_path)
    assert not [*tmp_path.iterdir()]


def test_a_methods_own_gaussians_leave_as_they_are(tmp_path):
    """Read back and turned back they give the same picture, from the same camera."""
    torch.manual_seed(3)
    count = 40
    cloud = Gaussians(
        means=torch.randn(count, 3) * 0.3,
        scales=torch.rand(count, 3) * 0.2 + 0.02,
        quaternions=torch.randn(count, 4),
        opacity=torch.rand(count) * 0.8 + 0.1,
        color=torch.rand(count, 3),
    )
    camera = Cameras.looking_at(
        torch.tensor([[0.3, -3.0, 1.0]]), torch.zeros(1, 3), focal=60.0, width=48, height=40
    )
    frame = UpFrame(torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), 2.0, "z")
    write_splats(tmp_path / "splats", MovingGaussians((0.0,), (cloud,)), {}, frame, 1.0)
    rows = torch.tensor(read(tmp_path / "splats", 1))
    back = torch.diag(torch.tensor(DOWN)) @ frame.rotation
    turned = rotation_matrix_to_quaternion(back.T @ rotations(rows[:, 13:]))
    found = Gaussians(
        means=rows[:, :3] @ back / 2,
        scales=rows[:, 10:13].exp() / 2,
        quaternions=turned,
        opacity=rows[:, 9].sigmoid(),
        color=rows[:, 6:9] * HARMONIC + 0.5,
    )
    expected, image = (splat(each, camera, 0.1).color for each in (cloud, found))
    assert float(expected.max()) > 0.3
    torch.testing.assert_close(image, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(rotations(turned), rotations(cloud.quaternions), atol=1e-5, rtol=0)
