"""glTF 2.0: a mesh that moves by morph targets, and the cameras that saw it, in one .glb file.

Libraries that write meshes leave out morph targets and their animation; the container is small.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

import devrf
from devrf.apps.export.geometry import MovingMesh, UpFrame, nearest, vertex_normals
from devrf.geometry.cameras import Cameras
from devrf.system.files import atomic_write

# Component types of the standard.
FLOAT = 5126
UNSIGNED_INT = 5125
UNSIGNED_SHORT = 5123
TYPES = {np.dtype("f4"): FLOAT, np.dtype("u4"): UNSIGNED_INT, np.dtype("u2"): UNSIGNED_SHORT}
# Buffer targets of the standard.
VERTICES = 34962
INDICES = 34963
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
# Types of the container's chunks, and its magic number.
JSON = 0x4E4F534A
BIN = 0x004E4942
MAGIC = 0x46546C67

Array = npt.NDArray[Any]


def write_gltf(
    path: Path, mesh: MovingMesh, cameras: dict[str, Cameras], frame: UpFrame, seconds: float
) -> None:
    """Write a .glb file.

    The mesh is as it is at the first time; for each other time there is a morph target that leads
    there, and the animation goes from one to the next: linearly, as displacements are between
    frames. Its colours are light that the cameras saw, so its material is unlit; the normals serve
    those who give it another material.

    Mesh and ``cameras``, one each by name, are in the scene's world; principal points are taken to
    be the centres. The mesh's node moves a mesh far from the origin there, since arrays are
    of float32. Time 0 to 1 takes ``seconds``.
    """
    content = _Content()
    vertices = frame.points(mesh.vertices)
    normals = torch.stack([vertex_normals(placed, mesh.faces) for placed in vertices])
    names = [f"t={time:.4g}" for time in mesh.times[1:]]
    # The standard's vertex colours are linear, with alpha, in 16 bits.
    rgba = torch.cat([linear(mesh.colors), torch.ones(len(mesh.colors), 1)], dim=1)
    rgba16 = (rgba * 65535).round().numpy().astype("u2")
    primitive: dict[str, Any] = {
        "attributes": {
            "POSITION": content.array(vertices[0].numpy(), VERTICES, limits=True),
            "NORMAL": content.array(normals[0].numpy(), VERTICES),
            "COLOR_0": content.array(rgba16, VERTICES, normalized=True),
        },
        "indices": content.array(mesh.faces.reshape(-1).numpy().astype("u4"), INDICES),
        "material": 0,
    }
    if names:
        moves = (vertices[1:] - vertices[0]).numpy()
        turns = (normals[1:] - normals[0]).numpy()
        primitive["targets"] = [
            {
                "POSITION": content.array(move, VERTICES, limits=True),
                "NORMAL": content.array(turn, VERTICES),
            }
            for move, turn in zip(moves, turns, strict=True)
        ]
    mesh_entry: dict[str, Any] = {"name": "scene", "primitives": [primitive]}
    nodes: list[dict[str, Any]] = [{"name": "scene", "mesh": 0}]
    if any(frame.offset):
        nodes[0]["translation"] = frame.origin
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"devrf {devrf.__version__}"},
        "scene": 0,
        "materials": [
            {
                "name": "radiance",
                "doubleSided": True,
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "extensionsUsed": ["KHR_materials_unlit"],
        "meshes": [mesh_entry],
        "nodes": nodes,
    }
    if names:
        mesh_entry |= {"weights": [0.0] * len(names), "extras": {"targetNames": names}}
        document["animations"] = [_animation(content, mesh.times, seconds)]
    if cameras:
        near = nearest(vertices)
        document["cameras"] = [
            {"name": name, "type": "perspective", "perspective": _lens(camera, near)}
            for name, camera in cameras.items()
        ]
        for index, (name, camera) in enumerate(cameras.items()):
            # The standard has columns one after another.
            matrix = frame.pose(camera).T.reshape(-1).tolist()
            nodes.append({"name": name, "camera": index, "matrix": matrix})
    extras = {"frame": f"y up ({frame.up} of the capture's world), metres"}
    document["scenes"] = [{"name": "scene", "nodes": list(range(len(nodes))), "extras": extras}]
    content.write(path, document)


def _animation(content: _Content, times: tuple[float, ...], seconds: float) -> dict[str, Any]:
    """Each target's weight is 1 at its own time and 0 at the others'."""
    keys = content.array(np.array(times, "f4") * np.float32(seconds), None, limits=True)
    weights = content.array(np.eye(len(times), dtype="f4")[:, 1:].reshape(-1), None)
    sampler = {"input": keys, "output": weights, "interpolation": "LINEAR"}
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    return {"name": "motion", "samplers": [sampler], "channels": [channel]}


def _lens(camera: Cameras, near: float) -> dict[str, float]:
    fx, fy = camera.focal[0].tolist()
    return {
        "yfov": 2 * math.atan(camera.height / (2 * fy)),
        "aspectRatio": (camera.width / fx) / (camera.height / fy),
        "znear": near,
    }


def linear(colors: Tensor) -> Tensor:
    """Linear light (..., 3) of sRGB colours (..., 3), both in [0, 1] (IEC 61966-2-1)."""
    dark = colors / 12.92
    return torch.where(colors <= 0.04045, dark, ((colors + 0.055) / 1.055) ** 2.4)


class _Content:
    """The binary part of a file, and its description."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._views: list[dict[str, int]] = []
        self._accessors: list[dict[str, Any]] = []

    def array(
        self, values: Array, target: int | None, *, limits: bool = False, normalized: bool = False
    ) -> int:
        """Put an array (N,) or (N, K) in; the number of its accessor."""
        values = np.ascontiguousarray(values)
        view = {"buffer": 0, "byteOffset": len(self._bytes), "byteLength": values.nbytes}
        self._views.append(view if target is None else {**view, "target": target})
        self._bytes += values.tobytes() + b"\0" * (-values.nbytes % 4)
        rows = values.reshape(len(values), -1)
        accessor: dict[str, Any] = {
            "bufferView": len(self._views) - 1,
            "componentType": TYPES[values.dtype],
            "count": len(rows),
            "type": KINDS[rows.shape[1]],
        }
        if limits:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        if normalized:
            accessor["normalized"] = True
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def write(self, path: Path, document: dict[str, Any]) -> None:
        """Write the file: a header, the description, the arrays."""
        described = document | {"buffers": [{"byteLength": len(self._bytes)}]}
        described |= {"bufferViews": self._views, "accessors": self._accessors}
        text = json.dumps(described, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(self._bytes)
        with atomic_write(path) as partial, partial.open("wb") as file:
            file.write(struct.pack("<3I", MAGIC, 2, length))
            file.write(struct.pack("<2I", len(text), JSON) + text)
            file.write(struct.pack("<2I", len(self._bytes), BIN) + self._bytes)
