"""Optical flow in files: ``<index>_bwd.npz``, ``<index>_fwd.npz``, and a cache of estimates."""

from __future__ import annotations

import hashlib
import logging
import math
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.scenes.files import decoding
from devrf.scenes.images import in_threads, raster_of
from devrf.scenes.resampling import shrink_flow
from devrf.scenes.scene import OpticalFlow, Views
from devrf.scenes.validation import check_memory, scene_error
from devrf.system.files import atomic_write

log = logging.getLogger(__name__)

REMEDY = "compute the flow again, or set data.flow=none"
# Backward or forward: the end of a file's name.
FlowDirection = Literal["bwd", "fwd"]
# Bytes a pixel of vectors and mask once they are read.
_BYTES = 9
# Pixels of an image with flow: of frames of 8K films. Each takes 25 bytes while flow is read.
_LARGEST = 8192 * 4320
# Bytes of the widest numbers, and of the header of an array.
_WIDEST = 16
_HEADER = 2**16


def read_flow_file(
    path: Path, width: int, height: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """The flow of one image of ``width`` × ``height`` pixels, before downscaling.

    The npz has ``flow`` (H, W, 2), pixels, x then y, and ``mask`` (H, W).

    Returns:
        vectors (H, W, 2) and valid (H, W); false where masked out, NaN, infinite or longer than the
        image's sides together, where the vectors are 0.

    Raises:
        DevrfError: not an npz, an array is missing, or an array is of another size.
    """
    if width * height > _LARGEST:
        raise scene_error(
            path, f"flow of {width}x{height} px, expected 8192x4320 at most; {REMEDY}"
        )
    shapes = {"flow": (height, width, 2), "mask": (height, width)}
    arrays = _arrays(path, shapes, REMEDY)
    for name, shape in shapes.items():
        array = arrays.get(name, np.empty(0, "O"))
        if array.shape != shape or array.dtype.kind not in "bfiu":
            raise scene_error(
                path,
                f'"{name}" has shape {array.shape} and type {array.dtype}, expected numbers of '
                f"shape {shape} as the image has before downscaling; {REMEDY}",
            )
    with np.errstate(over="ignore"):  # infinite is as good as too long
        vectors = arrays["flow"].astype(np.float32)
    # NaN compares false.
    valid = (arrays["mask"] > 0.5) & (np.abs(vectors) <= width + height).all(axis=-1)
    return np.where(valid[..., None], vectors, np.float32(0)), valid


def _arrays(path: Path, shapes: Mapping[str, tuple[int, ...]], remedy: str) -> dict[str, Any]:
    """The arrays of an npz file with the names of ``shapes``, none of them much larger than that.

    Unpacked data may be a thousand times as large as the file. DevrfError if it is no npz.
    """
    # Mapped, an array in place of an archive takes no memory.
    with decoding(path, "npz", remedy), np.load(path, mmap_mode="r") as archive:
        for member in archive.zip.infolist():
            shape = shapes.get(member.filename.removesuffix(".npy"))
            if shape is not None and member.file_size > _WIDEST * math.prod(shape) + _HEADER:
                raise ValueError(f"{member.filename} is larger than numbers of shape {shape}")
        # A member that is no array comes as bytes.
        return {name: np.asarray(archive[name]) for name in shapes if name in archive}


def stacked_flow(
    files: Mapping[int, Path],
    expected: int,
    pattern: Path,
    source_sizes: Sequence[tuple[int, int]],
    cameras: Cameras,
) -> OpticalFlow | None:
    """The flow of N images, whose numbers those of ``files`` are; the others have none.

    So many files, of names like ``pattern``, were ``expected``; None if there is no file.
    ``source_sizes`` are N (width, height) before downscaling, ``cameras`` those of the images after
    it: the flow's pixels.
    """
    if not files:
        log.info("no optical flow: no %s", pattern)
        return None
    if len(files) < expected:
        log.warning(
            "%d of %d flow files are missing, %s and its like; those images go without flow",
            *(expected - len(files), expected, pattern),
        )
    start = time.perf_counter()
    raster = (len(cameras), cameras.height, cameras.width)
    folder = next(iter(files.values())).parent
    check_memory(math.prod(raster) * _BYTES, folder, f"the flow of {len(cameras)} images")
    vectors = np.zeros((*raster, 2), dtype=np.float32)
    valid = np.zeros(raster, dtype=np.bool_)

    def fill(row: int) -> None:
        flow, mask = read_flow_file(files[row], source_sizes[row][0], source_sizes[row][1])
        width, height = cameras.size_of(row)
        if (width, height) != source_sizes[row]:
            flow, mask = shrink_flow(flow, mask, width, height)
        vectors[row, :height, :width] = flow
        valid[row, :height, :width] = mask

    in_threads(fill, files, raster_of(source_sizes))
    log.info(
        "read %d flow files from %s in %.1f s", len(files), folder, time.perf_counter() - start
    )
    return OpticalFlow(torch.from_numpy(vectors), torch.from_numpy(valid))


def write_flow(folder: Path, views: Views, images: Iterable[int]) -> None:
    """Write ``<index>_bwd.npz`` of ``images``, which have flow, into ``folder``, which is made."""
    folder.mkdir()
    for k in images:
        flow = views.single(k).flow
        assert flow is not None
        np.savez_compressed(
            folder / f"{k:03d}_bwd.npz",
            flow=flow.vectors[0].float().cpu().numpy(),
            mask=flow.valid[0].cpu().numpy(),
        )


# Part of the key: a new version makes the files of earlier estimates invalid.
VERSION = "2"


def content_key(views: Views, method: str) -> str:
    """A hash of the images, times and views that the flow of ``views`` depends on."""
    digest = hashlib.sha256(f"{VERSION} {method} {tuple(views.pixels.shape)}".encode())
    for part in (views.pixels, views.times, views.view):
        digest.update(part.cpu().contiguous().numpy().data)
    return digest.hexdigest()


def load_flow(path: Path, key: str, shape: tuple[int, int, int]) -> OpticalFlow | None:
    """The flow stored at ``path``, or None when there is none for these images.

    It must carry their :func:`content_key` and have the ``shape`` (N, H, W).
    """
    if not os.path.isfile(path):
        return None
    try:
        shapes = {"key": (len(key),), "vectors": (*shape, 2), "valid": shape}
        stored = _arrays(path, shapes, "it is written again")
        with decoding(path, "npz", "it is written again"):
            vectors, valid = (torch.from_numpy(stored[name]) for name in ("vectors", "valid"))
            sizes = (tuple(vectors.shape), tuple(valid.shape))
            fits = str(stored["key"]) == key and sizes == ((*shape, 2), shape)
    except DevrfError as error:
        log.warning("the flow is estimated again: %s", error)
        return None
    if not fits or not bool(vectors.isfinite().all()):
        log.info("%s holds the flow of other images or of another method", path)
        return None
    return OpticalFlow(vectors.float(), valid.bool())


def save_flow(path: Path, key: str, flow: OpticalFlow) -> None:
    """Write ``flow`` to ``path``, whole or not at all; DevrfError if it cannot be written."""
    try:
        with atomic_write(path) as partial:
            np.savez_compressed(
                partial, key=np.array(key), vectors=flow.vectors.numpy(), valid=flow.valid.numpy()
            )
    except OSError as error:
        raise scene_error(path, f"cannot write the flow ({error}); choose another folder") from None
