"""COLMAP's sparse models: cameras, posed images and points, binary or as text."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.scenes import colmap_binary, colmap_text
from devrf.scenes.colmap_entries import ModelCamera, ModelImage
from devrf.scenes.poses import in_reach
from devrf.scenes.validation import scene_error


@dataclass(frozen=True)
class SparseModel:
    """A model, images in the order of their names.

    Attributes:
        folder: where it is from.
        cameras: by their numbers.
        images: N of them.
        points: (P, 3) float64, world units.
        numbers: (P,) int64 ascending, the numbers of the points.
    """

    folder: Path
    cameras: dict[int, ModelCamera]
    images: tuple[ModelImage, ...]
    points: npt.NDArray[np.float64]
    numbers: npt.NDArray[np.int64]

    @cached_property
    def poses(self) -> Tensor:
        """(N, 3, 4) float64 camera-to-world, OpenGL axes, world units.

        Raises:
            DevrfError: a rotation or a position is none.
        """
        quaternion = torch.tensor([one.quaternion for one in self.images], dtype=torch.float64)
        length = quaternion.norm(dim=1, keepdim=True)
        w, x, y, z = (quaternion / length).unbind(dim=1)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        to_camera = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
        moved = torch.tensor([one.translation for one in self.images], dtype=torch.float64)
        position = -(to_camera.mT @ moved[:, :, None])
        # COLMAP's y points down and its z ahead; ours point up and back.
        axes = to_camera.mT * to_camera.new_tensor([1, -1, -1])
        good = ((length[:, 0] - 1).abs() < 1e-2) & in_reach(position[:, :, 0])
        if not bool(good.all()):
            name = self.images[int((~good).nonzero()[0])].name
            raise scene_error(
                self.folder, f"the pose of image {name} is no rigid transform; write it again"
            )
        return torch.cat([axes, position], dim=2)

    def depths(self, image: int) -> Tensor:
        """(K,) float64: how far along its axis the points of an image are, world units."""
        shown = np.intersect1d(self.images[image].points, self.numbers)
        place = np.searchsorted(self.numbers, shown)
        pose = self.poses[image]
        away = torch.from_numpy(self.points[place]) - pose[:, 3]
        return -(away @ pose[:, 2])


def model_folder(root: Path) -> Path | None:
    """Where a scene's model is: ``sparse/0``, ``sparse`` or ``colmap/sparse/0``; None: nowhere."""
    for inner in ("sparse/0", "sparse", "colmap/sparse/0"):
        if suffix_of(root / inner) is not None:
            return root / inner
    return None


def suffix_of(folder: Path) -> str | None:
    """How the model in a folder is written, ``.bin`` or ``.txt``; None: there is none."""
    for suffix in (".bin", ".txt"):
        if all(os.path.isfile(folder / f"{part}{suffix}") for part in ("cameras", "images")):
            return suffix
    return None


def read_model(folder: Path) -> SparseModel:
    """The sparse model in a folder, binary where both forms are there.

    ``points3D`` may be absent: then there are no points.

    Raises:
        DevrfError: a file is missing, damaged, or has a camera that cannot be read.
    """
    suffix = suffix_of(folder)
    if suffix is None:
        raise scene_error(
            folder, "no cameras.bin and images.bin, nor both as .txt; run COLMAP's mapper"
        )
    parts = colmap_binary if suffix == ".bin" else colmap_text
    cameras = parts.read_cameras(folder / f"cameras{suffix}")
    images = parts.read_images(folder / f"images{suffix}")
    if not images:
        raise scene_error(folder / f"images{suffix}", "lists no image; run COLMAP's mapper again")
    for one in images:
        if one.camera not in cameras:
            raise scene_error(
                folder / f"images{suffix}",
                f"image {one.name} has camera {one.camera}, which cameras{suffix} does not list",
            )
    numbers, points = np.zeros(0, np.int64), np.zeros((0, 3))
    if os.path.isfile(folder / f"points3D{suffix}"):
        numbers, points = parts.read_points(folder / f"points3D{suffix}")
    order = np.argsort(numbers, kind="stable")
    ordered = tuple(sorted(images, key=lambda one: one.name))
    return SparseModel(folder, cameras, ordered, points[order], numbers[order])
