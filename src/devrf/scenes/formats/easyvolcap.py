"""Scenes in EasyVolcap's layout: synchronised cameras that stand still, a folder of images each.

ENeRF-outdoor, SelfCap, NHR and ZJU-MoCap are distributed so.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.geometry.cameras import Distortion
from devrf.scenes.files import Numbers, decoding, existing_file
from devrf.scenes.image_folders import shot_together
from devrf.scenes.layout import Layout, with_static_times
from devrf.scenes.lens import Intrinsics
from devrf.scenes.names import ImageFinder
from devrf.scenes.reader import InwardReader
from devrf.scenes.transforms import Shot, posed_images
from devrf.scenes.validation import LARGEST, scene_error
from devrf.scenes.view_folders import held_out_view
from devrf.system.files import read_yaml
from devrf.system.options import abbreviated
from devrf.system.printed import is_shown

INTRINSICS = "intri.yml"
EXTRINSICS = "extri.yml"


@dataclass(frozen=True, kw_only=True)
class EasyVolcapReader(InwardReader):
    """Reads ``intri.yml``, ``extri.yml``, ``images/<camera>/`` and ``masks/<camera>/``.

    The files of all cameras are taken at once, in the order of their names. Images of the first
    time are the static set.

    Attributes:
        test_view: the held-out camera: 4 is the fourth of the file, −1 the last.
        masks: ``alpha``: what is black in ``masks/``, if it is there, is background; ``none``:
            masks are not read.
    """

    test_view: Annotated[int, Field(strict=True)] = -1
    masks: Literal["alpha", "none"] = "alpha"

    def layout(self, folder: Path) -> Layout:
        """See :meth:`devrf.scenes.reader.LayoutReader.layout`."""
        file = folder / INTRINSICS
        cameras = read_cameras(file, folder / EXTRINSICS)
        folders = [folder / "images" / name for name in cameras]
        for images in folders:
            if not os.path.isdir(images):
                raise scene_error(images, f"no such folder; {INTRINSICS} names this camera; add it")
        moments = [*zip(*shot_together(folders), strict=True)]
        masked = self.masks == "alpha" and os.path.isdir(folder / "masks")
        last = max(len(moments) - 1, 1)
        shots = [
            Shot(
                image=f"images/{name}/{image.name}",
                world_to_camera=world_to_camera,
                intrinsics=intrinsics,
                time=time / last,
                mask=f"masks/{name}/{image.name}" if masked else None,
            )
            for time, taken in enumerate(moments)
            for image, (name, (world_to_camera, intrinsics)) in zip(
                taken, cameras.items(), strict=True
            )
        ]
        everything = posed_images(file, shots, ImageFinder(folder), "error")
        test = held_out_view(len(cameras), self.test_view)
        held_out = range(test, len(shots), len(cameras))
        learned = sorted({*range(len(shots))} - {*held_out})
        return with_static_times(everything[learned], everything[held_out], 0.0)


def read_cameras(intrinsics: Path, extrinsics: Path) -> dict[str, tuple[Tensor, Intrinsics]]:
    """World-to-camera (3, 4) float64, OpenCV axes, and intrinsics of each camera, by its name.

    DevrfError if a file is missing or damaged, or lacks a camera.
    """
    lenses = OpenCVFile(intrinsics)
    places = OpenCVFile(extrinsics)
    cameras: dict[str, tuple[Tensor, Intrinsics]] = {}
    for name in lenses.names():
        (fx, skew, cx), (_, fy, cy), _ = lenses.numbers(f"K_{name}", 9).reshape(3, 3).tolist()
        width, height = (float(lenses.numbers(f"{side}_{name}", 1, (-1,))[0]) for side in "WH")
        distortion: list[float] = lenses.numbers(f"D_{name}", (4, 5, 8, 12, 14), [0.0] * 4).tolist()
        k1, k2, p1, p2, k3, *further = [*distortion, 0.0]
        if any(further):
            raise scene_error(
                intrinsics, f"D_{name}: only k1, k2, p1, p2, k3 are supported; undistort the images"
            )
        rotation = places.numbers(f"Rot_{name}", 9, ())
        if not len(rotation):
            rotation = np.asarray(cv2.Rodrigues(places.numbers(f"R_{name}", 3))[0], np.float64)
        to_camera = np.column_stack([rotation.reshape(3, 3), places.numbers(f"T_{name}", 3)])
        cameras[name] = (
            torch.from_numpy(to_camera),
            Intrinsics(
                (fx, fy),
                (cx, cy),
                (width, height) if min(width, height) > 0 else None,
                Distortion((k1, k2, k3, 0.0), (p1, p2)),
                skew,
            ),
        )
    if len(cameras) < 2:
        raise scene_error(intrinsics, f"names {len(cameras)} cameras, expected 2 or more; add them")
    return cameras


class OpenCVFile:
    """Numbers in a YAML file that OpenCV has written.

    OpenCV's own reader ends the program where a list is deep.
    """

    def __init__(self, file: Path) -> None:
        """Read it; DevrfError if it is missing or damaged."""
        self.file = existing_file(file, "it has the cameras; add it")
        with decoding(file, "YAML file of OpenCV", "write it again"):
            self._stored = read_yaml(file)
            if not isinstance(self._stored, dict):
                raise ValueError("no names")

    def names(self) -> list[str]:
        """The texts in the list ``names``, each the name of a folder."""
        stored = self._stored.get("names")
        names = stored if isinstance(stored, list) else [stored]
        for name in names:
            text = name if isinstance(name, str) else ""
            if text in ("", ".", "..") or not is_shown(text) or {*text} & {*"/\\"}:
                raise scene_error(
                    self.file, f"names: {abbreviated(name)} is no folder's name; correct it"
                )
        return names

    def numbers(
        self, key: str, counts: int | Sequence[int], default: Sequence[float] | None = None
    ) -> Numbers:
        """The matrix or the number at ``key``, as many as one of ``counts``.

        DevrfError if it is another, or not there and has no ``default``.
        """
        if key not in self._stored and default is not None:
            return np.array(default, dtype=np.float64)
        value = self._stored.get(key)
        value = value.get("data") if isinstance(value, dict) else value
        found = np.array(np.nan)
        with suppress(TypeError, ValueError, OverflowError):
            found = np.array(value if isinstance(value, list) else [value], dtype=np.float64)
        allowed = (counts,) if isinstance(counts, int) else counts
        # NaN compares false.
        if found.shape not in [(n,) for n in allowed] or not (np.abs(found) < LARGEST).all():
            expected = " or ".join(map(str, allowed))
            raise scene_error(self.file, f"{key}: expected {expected} finite numbers; correct it")
        return found
