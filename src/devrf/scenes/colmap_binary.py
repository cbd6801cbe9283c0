"""COLMAP's ``cameras.bin``, ``images.bin`` and ``points3D.bin``: little-endian, unaligned."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devrf.scenes.colmap_entries import PARAMETERS, ModelCamera, ModelImage, checked_camera
from devrf.scenes.paths import existing_file
from devrf.scenes.validation import scene_error

# Numbers of the camera models; of those that are not read a name for the message.
MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    *("FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
)
# A model of some ten thousand images.
MOST_BYTES = 4 * 2**30
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


class _Bytes:
    """A file's bytes, taken one after another."""

    def __init__(self, file: Path) -> None:
        if existing_file(file, "it is part of COLMAP's model; write the model again") > MOST_BYTES:
            raise scene_error(file, f"larger than {MOST_BYTES >> 30} GiB; write it again")
        self.file = file
        self.data = file.read_bytes()
        self.place = 0

    def take(self, form: str) -> tuple[int | float, ...]:
        """The next values."""
        size = struct.calcsize(form)
        self._has(size)
        values = struct.unpack_from(form, self.data, self.place)
        self.place += size
        return values

    def text(self) -> str:
        """The next text, which ends with a zero."""
        end = self.data.find(b"\0", self.place)
        if end < 0:
            self._has(len(self.data) + 1)
        text = self.data[self.place : end].decode(errors="surrogateescape")
        self.place = end + 1
        return text

    def array(self, dtype: np.dtype[np.void], count: int) -> npt.NDArray[np.void]:
        """The next ``count`` entries."""
        self._has(count * dtype.itemsize)
        values = np.frombuffer(self.data, dtype, count, self.place)
        self.place += count * dtype.itemsize
        return values

    def skip(self, size: int) -> None:
        """Pass over bytes."""
        self._has(size)
        self.place += size

    def count(self) -> int:
        """The next value, a number of entries."""
        return int(self.take("<Q")[0])

    def _has(self, size: int) -> None:
        if size > len(self.data) - self.place:
            raise scene_error(
                self.file,
                f"ends after {len(self.data)} bytes, in the middle of an entry; write it again",
            )


def read_cameras(file: Path) -> dict[int, ModelCamera]:
    """The cameras by their numbers; see :func:`devrf.scenes.colmap_model.read_model`."""
    source = _Bytes(file)
    cameras = {}
    for _ in range(source.count()):
        number, model, width, height = source.take("<iiQQ")
        name = MODELS[int(model)] if 0 <= model < len(MODELS) else f"number {model}"
        parameters = source.take(f"<{len(PARAMETERS.get(name, ()))}d")
        size = int(width), int(height)
        cameras[int(number)] = checked_camera(file, name, size, parameters)
    return cameras


def read_images(file: Path) -> list[ModelImage]:
    """The posed images; see :func:`devrf.scenes.colmap_model.read_model`."""
    source = _Bytes(file)
    images = []
    for _ in range(source.count()):
        _, w, x, y, z, tx, ty, tz, camera = source.take("<i7di")
        name = source.text()
        points = source.array(_OBSERVATION, source.count())["point"].astype(np.int64)
        images.append(
            ModelImage(name, int(camera), (w, x, y, z), (tx, ty, tz), points[points >= 0])
        )
    return images


def read_points(file: Path) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Numbers (P,) and positions (P, 3) of the points."""
    source = _Bytes(file)
    numbers, places = [], []
    for _ in range(source.count()):
        number, x, y, z = source.take("<q3d")
        source.skip(3 + 8)  # colour, error
        source.skip(8 * source.count())  # its track
        numbers.append(int(number))
        places.append((x, y, z))
    return np.array(numbers, np.int64), np.array(places, np.float64).reshape(-1, 3)
