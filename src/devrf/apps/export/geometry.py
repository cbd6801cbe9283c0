"""Exported geometry: a mesh that moves; and the settings of exports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, ClassVar, Literal, cast

import pydantic
import pydantic.dataclasses
import torch
from annotated_types import Ge, Gt, Le, Len, Lt, MinLen
from torch import Tensor
from torch.nn.functional import normalize

from devrf.apps.camera_paths import upward
from devrf.errors import DevrfError, expect
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.geometry.offset import NO_OFFSET, Offset
from devrf.rendering.renderable import Renderable
from devrf.system.options import Count, Options, Share

Format = Literal["gltf", "html", "ply", "obj", "splats", "usd", "csv", "json"]
# Formats of nothing but tracks.
TRACK_FORMATS = ("csv", "json")
Point = Annotated[Sequence[pydantic.FiniteFloat], Len(3, 3)]
Pixel = Annotated[Sequence[pydantic.FiniteFloat], Len(2, 2)]
Up = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]
Factor = Annotated[float, Ge(1e-9), Le(1e9)]
# The cameras' near plane, as a share of the scene's size.
NEAREST = 1e-3


@pydantic.dataclasses.dataclass(frozen=True)
class ExportSettings(Options):
    """Settings of ``stage=export``; ``conf/export/default.yaml`` says what each does."""

    key: ClassVar[str] = "export"

    format: Format = "gltf"
    content: Literal["auto", "surface", "points", "splats", "tracks"] = "auto"
    part: Literal["all", "moving", "still"] = "all"
    threshold: Annotated[float, Gt(0), Lt(1)] = 0.1
    side: Annotated[int, Ge(2), Le(1024)] | None = None
    faces: Annotated[int, Ge(4)] = 20_000
    pieces: Share = 0.01
    reach: Factor = 10.0
    colors: Literal["normal", "mean"] = "mean"
    points: Count = 20_000
    tracks: Annotated[Sequence[Point], MinLen(1)] | None = None
    pixels: Annotated[Sequence[Pixel], MinLen(1)] | None = None
    pixels_view: str = "held_out"
    pixels_time: Share = 0.0
    times: Annotated[Sequence[float], MinLen(1)] | None = None
    fps: Annotated[float, Gt(0), Le(1000)] | None = None
    seconds: Annotated[float, Ge(0.01), Le(3600)] = 3.0
    up: Up = "auto"
    metres: Factor = 1.0
    into: str | Path | None = None

    def __post_init__(self) -> None:
        if self.as_tracks:
            expect(self.content in ("auto", "tracks"), "export.content", "tracks", self.content)
            kinds = (*TRACK_FORMATS, "usd")
            expect(self.format in kinds, "export.format", "csv, json or usd of tracks", self.format)
            either = (self.tracks is None) != (self.pixels is None)
            expected = "points [[x,y,z],...] at rest, or export.pixels in place of them"
            expect(either, "export.tracks", expected, self.tracks)
            expect(self.part == "all", "export.part", "all with tracks", self.part)
        if self.times is None:
            return
        if self.fps is not None:
            raise DevrfError("export.times: export.fps also says which times; give one of them")
        rising = all(a < b for a, b in pairwise([-1e-9, *self.times, 1 + 1e-9]))
        ascending = "ascending times from 0 to 1"
        expect(rising, "export.times", ascending, list(self.times))

    @property
    def as_splats(self) -> bool:
        """Whether Gaussians are asked for."""
        return self.format == "splats" or (self.format == "usd" and self.content == "splats")

    @property
    def as_tracks(self) -> bool:
        """Whether the ways of points are asked for, by content, format, or these points."""
        of_tracks = self.content == "tracks" or self.format in TRACK_FORMATS
        return of_tracks or self.tracks is not None or self.pixels is not None

    def export_times(self, clock: FrameClock) -> tuple[float, ...]:
        """The times to export, of a scene whose training frames have the clock's times."""
        if self.times is not None:
            return tuple(self.times)
        if self.fps is not None:
            steps = max(1, round(self.seconds * self.fps))
            return tuple(k / steps for k in range(steps + 1))
        return clock.times


@dataclass(frozen=True)
class UpFrame:
    """The way from the capture's world to right-handed axes with y up, in metres.

    Attributes:
        rotation: (3, 3) axes of the world onto axes of the frame.
        metres: length of a unit of the world.
        up: the world's axis that becomes y.
        offset: of the scene in the capture's world (:mod:`devrf.geometry.offset`).
    """

    rotation: Tensor
    metres: float
    up: str
    offset: Offset = NO_OFFSET

    @classmethod
    def of(cls, cameras: Cameras, up: Up, metres: float, offset: Offset = NO_OFFSET) -> UpFrame:
        """The frame of a scene; ``auto`` takes the axis nearest to what is up to the cameras."""
        if up == "auto":
            direction = upward(cameras)
            axis = int(direction.abs().argmax())
            up = cast(Up, "-" * bool(direction[axis] < 0) + "xyz"[axis])
        axis = "xyz".index(up[-1])
        sign = -1.0 if up.startswith("-") else 1.0
        x = torch.zeros(3)
        y = torch.zeros(3)
        x[1 if axis == 0 else 0] = 1.0
        y[axis] = sign
        return cls(torch.stack([x, y, torch.linalg.cross(x, y)]), metres, up, offset)

    @property
    def origin(self) -> list[float]:
        """x, y, z of the scene's origin in the frame, in double precision.

        It has to be added to :meth:`points`, which are of float32.
        """
        rotation = self.rotation.double()
        origin: list[float] = (self.metres * (rotation @ rotation.new_tensor(self.offset))).tolist()
        return origin

    def points(self, points: Tensor) -> Tensor:
        """Points (..., 3) of the scene in the frame, from :attr:`origin`."""
        return self.metres * (points @ self.rotation.T)

    def pose(self, camera: Cameras) -> Tensor:
        """Camera-to-frame (4, 4) float64 of one camera of the scene, OpenGL axes."""
        pose = camera.camera_to_world[0]
        camera_to_frame = torch.eye(4, dtype=torch.float64)
        camera_to_frame[:3, :3] = self.rotation @ pose[:, :3]
        camera_to_frame[:3, 3] = self.points(pose[:, 3]) + camera_to_frame.new_tensor(self.origin)
        return camera_to_frame


@dataclass(frozen=True)
class Surface:
    """A mesh at rest.

    Attributes:
        points: (V, 3) canonical vertices in the fields' space, on the host.
        faces: (F, 3) int64, counter-clockwise from outside as the world is seen.
        colors: (V, 3) RGB in [0, 1], encoded as the images are (sRGB).
    """

    points: Tensor
    faces: Tensor
    colors: Tensor


@dataclass(frozen=True)
class MovingMesh:
    """A mesh at T times, ascending in [0, 1].

    Attributes:
        vertices: (T, V, 3) float32, in the scene's world.
        faces: (F, 3) int64, counter-clockwise from outside.
        colors: (V, 3) RGB in [0, 1], sRGB.
    """

    times: tuple[float, ...]
    vertices: Tensor
    faces: Tensor
    colors: Tensor


def carried(surface: Surface, model: Renderable, times: Sequence[float]) -> MovingMesh:
    """A surface at rest, carried through time: each canonical vertex q goes to x(q, t)."""
    points = surface.points.to(model.device)
    moved = []
    for time in times:
        forward = model.forward_warp(time)
        assert forward is not None  # every model with a surface has one
        moved.append(model.space.to_world(forward(points)).float().cpu())
    return MovingMesh(tuple(times), torch.stack(moved), surface.faces, surface.colors)


def nearest(points: Tensor) -> float:
    """The distance of cameras' near plane that suits points (T, V, 3) of a frame, in its units."""
    return NEAREST * float((points.amax(dim=(0, 1)) - points.amin(dim=(0, 1))).norm())


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (V, 3) of vertices (V, 3): means over the faces (F, 3) around, by area.

    They point to where faces are counter-clockwise from; along z where all faces around are empty.
    """
    a, b, c = vertices[faces].unbind(dim=1)
    across = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(vertices)
    for corner in range(3):
        normals.index_add_(0, faces[:, corner], across)
    lengths = normals.norm(dim=1, keepdim=True)
    return torch.where(lengths > 0, normals / lengths, torch.eye(3)[2])


def halfway(normals: Tensor) -> Tensor:
    """Unit vectors (V, 3) halfway from +z to unit ``normals``: half a turn about each leads there.

    For −z it is half a turn about x.
    """
    between = normals + torch.eye(3)[2]
    between = torch.where(between.norm(dim=1, keepdim=True) > 1e-3, between, torch.eye(3)[0])
    return normalize(between, dim=1)
