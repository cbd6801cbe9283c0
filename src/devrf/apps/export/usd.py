"""USD: what moves by time samples, and the cameras that saw it, in one .usdc file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from devrf.apps.export.geometry import MovingMesh, UpFrame, nearest, vertex_normals
from devrf.apps.export.gltf import linear
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.system.files import atomic_write

# Time codes a second: sampled times need not be whole ones.
RATE = 24.0
# Width of a camera's film, in tenths of a unit; only its ratio to the focal length is seen.
FILM = 20.955
# The cameras' far plane, in distances of the near one: as that of USD's own default.
FARTHEST = 1e6


class SceneFile:
    """A stage of USD with y up, in metres, that plays once.

    Attributes:
        stage: pxr's.
        codes: the time code of each time.
    """

    def __init__(self, times: Sequence[float], frame: UpFrame, seconds: float) -> None:
        """A stage without content.

        Args:
            times: in [0, 1], ascending.
            frame: of what it will hold.
            seconds: duration of time 0 to 1.
        """
        from pxr import Usd, UsdGeom  # an extra

        self.stage: Any = Usd.Stage.CreateInMemory()
        self.codes = [time * seconds * RATE for time in times]
        self._frame = frame
        UsdGeom.SetStageUpAxis(self.stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(self.stage, 1.0)
        self.stage.SetTimeCodesPerSecond(RATE)
        self.stage.SetFramesPerSecond(RATE)
        self.stage.SetStartTimeCode(self.codes[0])
        self.stage.SetEndTimeCode(self.codes[-1])
        root = UsdGeom.Xform.Define(self.stage, "/scene")
        self.stage.SetDefaultPrim(root.GetPrim())

    def move_to_origin(self, shape: Any) -> None:
        """Move a shape, whose points are of float32, to where the scene's world has its origin."""
        from pxr import Gf

        if any(self._frame.offset):
            shape.AddTranslateOp().Set(Gf.Vec3d(self._frame.origin))

    def write(self, path: Path, cameras: Mapping[str, Cameras], points: Tensor) -> None:
        """Write the stage, with the ``cameras`` by their names, which see ``points`` (T, V, 3)."""
        from pxr import Gf, Sdf, Tf, UsdGeom

        near = nearest(points)
        for name, camera in cameras.items():
            lens = UsdGeom.Camera.Define(self.stage, Sdf.Path(f"/scene/cameras/{name}"))
            fx, fy = camera.focal[0].tolist()
            focal = FILM * fx / camera.width
            lens.CreateHorizontalApertureAttr(FILM)
            lens.CreateVerticalApertureAttr(focal * camera.height / fy)
            lens.CreateFocalLengthAttr(focal)
            lens.CreateClippingRangeAttr(Gf.Vec2f(near, FARTHEST * near))
            # Gf multiplies rows from the left.
            lens.AddTransformOp().Set(Gf.Matrix4d(self._frame.pose(camera).T.tolist()))
        with atomic_write(path) as partial:
            try:
                self.stage.GetRootLayer().Export(str(partial))
            except Tf.ErrorException:  # it has no number of the system's
                where = f"{path}: cannot be written"
                raise DevrfError(f"{where}; see that there is room on the disk") from None


def write_usd(
    path: Path, mesh: MovingMesh, cameras: Mapping[str, Cameras], frame: UpFrame, seconds: float
) -> None:
    """Write a .usdc file; arguments as for :func:`~devrf.apps.export.gltf.write_gltf`."""
    from pxr import UsdGeom, Vt

    file = SceneFile(mesh.times, frame, seconds)
    shape = UsdGeom.Mesh.Define(file.stage, "/scene/mesh")
    file.move_to_origin(shape)
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    shape.CreateFaceVertexCountsAttr(Vt.IntArray([3] * len(mesh.faces)))
    faces = mesh.faces.reshape(-1).numpy().astype(np.int32)
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces))
    colors = Vt.Vec3fArray.FromNumpy(linear(mesh.colors).numpy())
    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(colors)
    samples = shape.CreatePointsAttr()
    extent = shape.CreateExtentAttr()
    normals = shape.CreateNormalsAttr()
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    points = frame.points(mesh.vertices)
    for code, vertices in zip(file.codes, points, strict=True):
        placed = Vt.Vec3fArray.FromNumpy(vertices.contiguous().numpy())
        samples.Set(placed, code)
        turned = vertex_normals(vertices, mesh.faces)
        normals.Set(Vt.Vec3fArray.FromNumpy(turned.contiguous().numpy()), code)
        extent.Set(UsdGeom.PointBased.ComputeExtent(placed), code)
    file.write(path, cameras, points)
