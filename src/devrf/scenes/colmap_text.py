"""COLMAP's ``cameras.txt``, ``images.txt`` and ``points3D.txt``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devrf.scenes.colmap_entries import ModelCamera, ModelImage, checked_camera
from devrf.scenes.paths import existing_file
from devrf.scenes.validation import abbreviated, scene_error

MOST_BYTES = 2 * 2**30


def read_cameras(file: Path) -> dict[int, ModelCamera]:
    """The cameras by their numbers; see :func:`devrf.scenes.colmap_model.read_model`."""
    cameras = {}
    for line in filter(None, _lines(file)):
        with _understood(file, line):
            number, model, width, height, *values = line.split()
            size, parameters = (int(width), int(height)), tuple(map(float, values))
            place = int(number)
        cameras[place] = checked_camera(file, model, size, parameters)
    return cameras


def read_images(file: Path) -> list[ModelImage]:
    """The posed images; see :func:`devrf.scenes.colmap_model.read_model`."""
    lines = _lines(file)
    images = []
    for line in lines:
        if not line:
            continue
        seen = next(lines, "")  # an image that shows no point has an empty line
        with _understood(file, line):
            _, w, x, y, z, tx, ty, tz, camera, name = line.split(maxsplit=9)
            quaternion = float(w), float(x), float(y), float(z)
            moved = float(tx), float(ty), float(tz)
            number = int(camera)
        with _understood(file, seen):
            points = np.array(seen.split()[2::3], np.int64)
        images.append(ModelImage(name, number, quaternion, moved, points[points >= 0]))
    return images


def read_points(file: Path) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Numbers (P,) and positions (P, 3) of the points."""
    numbers, places = [], []
    for line in filter(None, _lines(file)):
        with _understood(file, line):
            number, x, y, z = line.split(maxsplit=4)[:4]
            numbers.append(np.int64(number))
            places.append((float(x), float(y), float(z)))
    return np.array(numbers, np.int64), np.array(places, np.float64).reshape(-1, 3)


def _lines(file: Path) -> Iterator[str]:
    """The lines without comments; empty ones stay, since they can be entries."""
    if existing_file(file, "it is part of COLMAP's model; write the model again") > MOST_BYTES:
        raise scene_error(file, f"larger than {MOST_BYTES >> 30} GiB; write it again")
    with file.open(errors="surrogateescape") as stream:
        for line in stream:
            if not line.startswith("#"):
                yield line.strip()


@contextmanager
def _understood(file: Path, line: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, OverflowError):
        raise scene_error(
            file, f"the line {abbreviated(line)} is not one of COLMAP's; write it again"
        ) from None
