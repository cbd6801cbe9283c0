"""What other programs read: a mesh that goes where the forward warp leads, in every format."""

from __future__ import annotations

import json
import math
import resource
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from pxr import Gf, Usd, UsdGeom

from devrf.apps.export.geometry import ExportSettings, MovingMesh, UpFrame, carried
from devrf.apps.export.gltf import write_gltf
from devrf.apps.export.sequence import mesh_files, point_file, write_files
from devrf.apps.export.splats import MovingGaussians, write_usd_splats
from devrf.apps.export.surface import surface_of
from devrf.apps.export.usd import write_usd
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer
from devrf.rendering.seen_points import seen_points

TIMES = (0.0, 0.25, 0.5, 1.0)
SECONDS = 2.0


def moved_mesh(model, cameras, times, **settings):
    surface = surface_of(model, model.surface(), cameras, ExportSettings(**settings))
    return carried(surface, model, times)


@pytest.fixture(scope="module")
def mesh(moving_ball, around):
    return moved_mesh(moving_ball, around, TIMES, faces=800)


@pytest.fixture(scope="module")
def frame(around):
    return UpFrame.of(around, "auto", 2.0)


@pytest.mark.parametrize(
    ("up", "expected"), [("z", (1.0, 3.0, -2.0)), ("-z", (1.0, -3.0, 2.0)), ("x", (2.0, 1.0, -3.0))]
)
def test_the_frame_by_hand(around, up, expected):
    frame = UpFrame.of(around, up, 0.5)
    found = frame.points(torch.tensor([1.0, 2.0, 3.0]))
    assert found.tolist() == [0.5 * value for value in expected]
    assert torch.linalg.det(frame.rotation) == 1


def test_up_is_that_of_cameras_that_look_down_from_one_side():
    angle = torch.linspace(-0.5, 0.5, 6)
    places = torch.stack([2 * angle.cos(), 2 * angle.sin(), torch.full_like(angle, 4.0)], dim=1)
    cameras = Cameras.looking_at(places, torch.zeros(6, 3), focal=60.0, width=48, height=36)
    assert UpFrame.of(cameras, "auto", 1.0).up == "z"


def glb(path):
    """The description of a .glb file, and its arrays by the number of their accessor."""
    content = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", content[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    whole = json.loads(content[20 : 20 + size])
    binary = content[28 + size :]
    assert len(binary) == whole["buffers"][0]["byteLength"]

    def array(number):
        one = whole["accessors"][number]
        view = whole["bufferViews"][one["bufferView"]]
        own = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[one["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[one["type"]]
        found = np.frombuffer(binary, own, one["count"] * width, view["byteOffset"])
        found = found.reshape(-1, width)
        if "min" in one:
            assert (found.min(0) == one["min"]).all() and (found.max(0) == one["max"]).all()
        return found

    return whole, array


def morphed(whole, array, seconds, attribute="POSITION"):
    """The mesh's vertices so many seconds into the animation, as the standard says."""
    primitive = whole["meshes"][0]["primitives"][0]
    sampler = whole["animations"][0]["samplers"][0]
    keys = array(sampler["input"])[:, 0]
    weights = array(sampler["output"]).reshape(len(keys), -1)
    vertices = array(primitive["attributes"][attribute]).astype(float)
    for target, of_target in zip(primitive["targets"], weights.T, strict=True):
        vertices = vertices + np.interp(seconds, keys, of_target) * array(target[attribute])
    return vertices


def test_gltf_goes_where_the_forward_field_leads(tmp_path, moving_ball, mesh, frame):
    path = tmp_path / "ball.glb"
    grey = replace(mesh, colors=torch.full_like(mesh.colors, 0.5))
    write_gltf(path, grey, {}, frame, SECONDS)
    whole, array = glb(path)
    colors = array(whole["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]) / 65535
    # Vertex colours are linear light: sRGB 0.5 is 21.4 % of it.
    np.testing.assert_allclose(colors[:, :3], 0.21404, atol=1e-4)
    at_rest = mesh.vertices[0]
    (read,) = trimesh.load_scene(path, process=False).geometry.values()
    assert (read.faces == mesh.faces.numpy()).all()
    # y up and twice as large: a ball of radius 1.
    assert read.volume == pytest.approx(4 / 3 * math.pi, rel=0.05)
    # 0.8 lies between two exported times, and the forward warp goes evenly from one to the other.
    for time in (*TIMES, 0.8):
        expected = frame.points(moving_ball.forward_warp(time)(at_rest)).numpy()
        np.testing.assert_allclose(morphed(whole, array, SECONDS * time), expected, atol=1e-5)


def test_normals_point_out_of_a_ball_that_is_pulled_long(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3)
    points = torch.tensor(ball.vertices, dtype=torch.float32)
    pull = torch.tensor([[1.0, 1, 1], [3.0, 1, 1]])
    faces = torch.tensor(ball.faces)
    mesh = MovingMesh((0.0, 1.0), points * pull[:, None], faces, torch.zeros_like(points))
    # Its frame turns x to y.
    frame = UpFrame(torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), 1e-3, "x")
    write_gltf(tmp_path / "ball.glb", mesh, {}, frame, SECONDS)
    write_usd(tmp_path / "ball.usdc", mesh, {}, frame, SECONDS)
    whole, array = glb(tmp_path / "ball.glb")
    (read,) = trimesh.load_scene(tmp_path / "ball.glb", process=False).geometry.values()
    stage = Usd.Stage.Open(str(tmp_path / "ball.usdc"))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh"))
    for seconds, stretch in ((0.0, 1.0), (SECONDS, 3.0)):
        # The gradient of (x / a)² + y² + z² at the surface's point (a x, y, z).
        gradient = points / torch.tensor([stretch, 1.0, 1.0])
        expected = frame.points(torch.nn.functional.normalize(gradient, dim=1)) * 1e3
        found = morphed(whole, array, seconds, "NORMAL")
        np.testing.assert_allclose((found * expected.numpy()).sum(axis=1), 1, atol=4e-3)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
        code = seconds * stage.GetTimeCodesPerSecond()
        np.testing.assert_allclose(shape.GetNormalsAttr().Get(code), found, atol=1e-5)
    np.testing.assert_allclose(read.vertex_normals, array(1), atol=1e-6)


def test_gltf_cameras_see_the_ball_where_the_captures_do(tmp_path, mesh, frame, around):
    named = {f"static_{k}": around[[k]] for k in range(6)}
    write_gltf(tmp_path / "ball.glb", mesh, named, frame, SECONDS)
    whole, array = glb(tmp_path / "ball.glb")
    vertices = array(0).astype(float)
    assert [one["name"] for one in whole["cameras"]] == list(named)
    for index, node in enumerate(whole["nodes"][1:]):
        pose = np.array(node["matrix"]).reshape(4, 4).T
        local = (np.c_[vertices, np.ones(len(vertices))] @ np.linalg.inv(pose).T)[:, :3]
        lens = whole["cameras"][node["camera"]]["perspective"]
        y = local[:, 1] / -local[:, 2] / math.tan(lens["yfov"] / 2)
        x = local[:, 0] / -local[:, 2] / math.tan(lens["yfov"] / 2) / lens["aspectRatio"]
        seen, _ = around.project_into(index, mesh.vertices[0])
        # Of the image's −1 to 1 its pixels: x to the right, y down from the top.
        pixels = np.stack([(x + 1) * 48 / 2, (1 - y) * 36 / 2], axis=1)
        np.testing.assert_allclose(pixels, seen.numpy(), atol=1e-3)


def test_usd_has_a_sample_for_each_time(tmp_path, mesh, frame, around):
    path = tmp_path / "ball.usdc"
    write_usd(path, mesh, {"static_1": around[[1]]}, frame, SECONDS)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh"))
    rate = stage.GetTimeCodesPerSecond()
    assert shape.GetPointsAttr().GetTimeSamples() == [t * SECONDS * rate for t in TIMES]
    for time, vertices in zip(TIMES, mesh.vertices, strict=True):
        found = np.array(shape.GetPointsAttr().Get(time * SECONDS * rate))
        np.testing.assert_allclose(found, frame.points(vertices), atol=1e-6)
    assert len(shape.GetDisplayColorPrimvar().Get()) == mesh.vertices.shape[1]
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/scene/cameras/static_1")).GetCamera(0)
    eye = camera.frustum.position
    np.testing.assert_allclose(eye, frame.points(around.positions[1]), atol=1e-5)
    # What the camera sees of the ball's middle is what the capture's does.
    shown = camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix()
    x, y, _ = shown.Transform(Gf.Vec3d(*frame.points(mesh.vertices[0, 7]).tolist()))
    seen, _ = around.project_into(1, mesh.vertices[0, 7:8])
    assert [(x + 1) * 24, (1 - y) * 18] == pytest.approx(seen[0].tolist(), abs=1e-2)


def test_usd_where_files_have_no_room_is_one_line(tmp_path, mesh, frame):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(DevrfError, match="ball.usdc: cannot be written; see that there is"):
            write_usd(tmp_path / "ball.usdc", mesh, {}, frame, SECONDS)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("metres", [0.1, 1000.0])
@pytest.mark.parametrize("write", [write_usd, write_usd_splats])
def test_usd_cameras_see_the_whole_ball_in_any_unit(tmp_path, mesh, around, write, metres):
    frame = UpFrame.of(around, "auto", metres)
    content = mesh if write is write_usd else MovingGaussians.on_surface(mesh)
    write(tmp_path / "ball.usdc", content, {"static_0": around[[0]]}, frame, SECONDS)
    stage = Usd.Stage.Open(str(tmp_path / "ball.usdc"))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/scene/cameras/static_0")).GetCamera(0)
    near, far = camera.clippingRange.min, camera.clippingRange.max
    points = frame.points(mesh.vertices.flatten(0, 1)).tolist()
    view = camera.frustum.ComputeViewMatrix()
    depths = [-view.Transform(Gf.Vec3d(*point))[2] for point in points]
    assert 0 < near < min(depths) / 100 and max(depths) < far / 100
    assert all(camera.frustum.Intersects(Gf.Vec3d(*point)) for point in points)


@pytest.mark.parametrize("format", ["ply", "obj"])
def test_a_file_a_time_and_an_index(tmp_path, mesh, format):
    own = ("frame_notes.txt", f"frame_of_mine_3.{format}")
    for name in (f"frame_0009.{format}", *own):
        (tmp_path / name).touch()
    write_files(tmp_path, f"frame_{{:04d}}.{format}", mesh_files(mesh, format), TIMES, SECONDS, {})
    index = json.loads((tmp_path / "index.json").read_text())
    assert [(one["time"], one["seconds"]) for one in index["frames"]] == [
        (time, 2 * time) for time in TIMES
    ]
    for one, vertices in zip(index["frames"], mesh.vertices, strict=True):
        read = trimesh.load_mesh(tmp_path / one["file"], process=False)
        np.testing.assert_allclose(read.vertices, vertices, atol=1e-5)
        assert (read.faces == mesh.faces.numpy()).all()
        assert (read.visual.vertex_colors[:, 0] > 250).all()
        assert (read.visual.vertex_colors[:, 1] < 5).all()
    # What an earlier, longer sequence left is gone; what is not its own stays.
    assert not (tmp_path / f"frame_0009.{format}").exists()
    assert all((tmp_path / name).exists() for name in own)


FAR = (500_000.0, 5_600_000.0, 200.0)


@pytest.mark.parametrize("format", ["ply", "obj"])
def test_files_far_from_the_origin_keep_their_digits(tmp_path, mesh, format):
    *_, last = mesh_files(mesh, format, FAR)
    (tmp_path / f"mesh.{format}").write_bytes(last)
    read = trimesh.load_mesh(tmp_path / f"mesh.{format}", process=False)
    expected = mesh.vertices[-1].double().numpy() + FAR
    np.testing.assert_allclose(read.vertices, expected, rtol=0, atol=1e-6)
    assert (read.faces == mesh.faces.numpy()).all()
    assert (read.visual.vertex_colors[:, 0] > 250).all()


def test_points_far_from_the_origin_keep_their_digits(tmp_path):
    points = torch.rand(5, 3)
    colors = torch.tensor([[1.0, 0.0, 0.0]]).expand(5, 3)
    (tmp_path / "points.ply").write_bytes(point_file(points, colors, FAR))
    read = trimesh.load(tmp_path / "points.ply")
    np.testing.assert_allclose(read.vertices, points.double().numpy() + FAR, rtol=0, atol=1e-9)
    assert (read.colors == [255, 0, 0, 255]).all()


def test_gltf_and_usd_move_everything_far_from_the_origin(tmp_path, mesh, around):
    frame = UpFrame.of(around, "z", 2.0, FAR)  # x, z, −y
    origin = np.array([1_000_000.0, 400.0, -11_200_000.0])
    cameras = {"static_1": around[[1]]}
    eye = frame.points(around.positions[1]).double().numpy() + origin
    vertices = frame.points(mesh.vertices[0]).double().numpy() + origin
    write_gltf(tmp_path / "ball.glb", mesh, cameras, frame, SECONDS)
    scene = trimesh.load_scene(tmp_path / "ball.glb", process=False)
    np.testing.assert_allclose(scene.to_mesh().vertices, vertices, rtol=0, atol=1e-5)
    np.testing.assert_allclose(scene.camera_transform[:3, 3], eye, rtol=0, atol=1e-5)
    write_usd(tmp_path / "ball.usdc", mesh, cameras, frame, SECONDS)
    stage = Usd.Stage.Open(str(tmp_path / "ball.usdc"))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/scene/cameras/static_1")).GetCamera(0)
    np.testing.assert_allclose(camera.frustum.position, eye, rtol=0, atol=1e-5)
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh"))
    way = shape.ComputeLocalToWorldTransform(0)
    placed = way.Transform(Gf.Vec3d(*map(float, shape.GetPointsAttr().Get(0)[7])))
    np.testing.assert_allclose(placed, vertices[7], rtol=0, atol=1e-5)


def test_points_lie_on_the_ball_at_its_time(moving_ball, around):
    points, colors = seen_points(Renderer(moving_ball), around, 1.0, 1.0, 300)
    assert points.shape == colors.shape == (300, 3)
    away = (points - torch.tensor([0.4, 0.0, 0.0])).norm(dim=1)
    # Light goes no deeper than a voxel, in the mean. They are all around the ball, and red.
    assert (away - 0.6).abs().mean() < 1 / 12
    assert (points[:, 1].amin() < -0.4) and (points[:, 1].amax() > 0.4)
    assert (colors[:, 0] > 0.95).all()
