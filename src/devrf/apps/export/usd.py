"""USD: a mesh whose points have time samples, and the cameras that saw it, in one .usdc file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from devrf.apps.export.geometry import MovingMesh, UpFrame, vertex_normals
from devrf.apps.export.gltf import linear
from devrf.geometry.cameras import Cameras
from devrf.system.files import atomic_write

# Time codes a second: sampled times need not be whole ones.
RATE = 24.0
# Width of a camera's film, in tenths of a unit; only its ratio to the focal length is seen.
FILM = 20.955


def write_usd(
    path: Path, mesh: MovingMesh, cameras: dict[str, Cameras], frame: UpFrame, seconds: float
) -> None:
    """Write a .usdc file; arguments as for :func:`~devrf.apps.export.gltf.write_gltf`."""
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt  # an extra

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(RATE)
    stage.SetFramesPerSecond(RATE)
    codes = [time * seconds * RATE for time in mesh.times]
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    root = UsdGeom.Xform.Define(stage, "/scene")
    stage.SetDefaultPrim(root.GetPrim())
    shape = UsdGeom.Mesh.Define(stage, "/scene/mesh")
    if any(frame.offset):
        shape.AddTranslateOp().Set(Gf.Vec3d(frame.origin))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    shape.CreateFaceVertexCountsAttr(Vt.IntArray([3] * len(mesh.faces)))
    faces = mesh.faces.reshape(-1).numpy().astype(np.int32)
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces))
    colors = Vt.Vec3fArray.FromNumpy(linear(mesh.colors).numpy())
    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(colors)
    points = shape.CreatePointsAttr()
    extent = shape.CreateExtentAttr()
    normals = shape.CreateNormalsAttr()
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    for code, vertices in zip(codes, frame.points(mesh.vertices), strict=True):
        placed = Vt.Vec3fArray.FromNumpy(vertices.contiguous().numpy())
        points.Set(placed, code)
        turned = vertex_normals(vertices, mesh.faces)
        normals.Set(Vt.Vec3fArray.FromNumpy(turned.contiguous().numpy()), code)
        extent.Set(UsdGeom.PointBased.ComputeExtent(placed), code)
    for name, camera in cameras.items():
        lens = UsdGeom.Camera.Define(stage, Sdf.Path(f"/scene/cameras/{name}"))
        fx, fy = camera.focal[0].tolist()
        focal = FILM * fx / camera.width
        lens.CreateHorizontalApertureAttr(FILM)
        lens.CreateVerticalApertureAttr(focal * camera.height / fy)
        lens.CreateFocalLengthAttr(focal)
        # Gf multiplies rows from the left.
        lens.AddTransformOp().Set(Gf.Matrix4d(frame.pose(camera).T.tolist()))
    with atomic_write(path) as partial:
        stage.GetRootLayer().Export(str(partial))
