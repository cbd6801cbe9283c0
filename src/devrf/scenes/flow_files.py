"""Optical flow from files: ``<index>_bwd.npz`` next to the images of a dynamic set."""

from __future__ import annotations

import logging
import time
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from devrf.scenes.images import workers
from devrf.scenes.resampling import shrink_flow
from devrf.scenes.scene import OpticalFlow
from devrf.scenes.validation import problem

log = logging.getLogger(__name__)

UNREADABLE = (
    OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError
)


def _declared(path: Path) -> dict[str, tuple[int, ...]]:
    """The shapes of the arrays in an npz as their headers give them: nothing is unpacked."""
    shapes = {}
    with zipfile.ZipFile(path) as archive:
        for name in ("flow", "mask"):
            if f"{name}.npy" not in archive.namelist():
                continue
            with archive.open(f"{name}.npy") as member:
                version = np.lib.format.read_magic(member)
                old = version == (1, 0)
                read = np.lib.format.read_array_header_1_0 if old else (
                    np.lib.format.read_array_header_2_0
                )
                shapes[name] = read(member)[0]
    return shapes


def read_flow_file(
    path: Path, width: int, height: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """One backward flow.

    Args:
        path: an npz with ``flow`` (H, W, 2), pixels, x then y, and ``mask`` (H, W).
        width: columns of the image it belongs to, before downscaling.
        height: rows of that image.

    Returns:
        vectors (H, W, 2) and valid (H, W); false where masked out, NaN or infinite, where the
        vectors are 0.

    Raises:
        DevrfError: not an npz, an array is missing, or an array is of another size.
    """
    try:
        shapes = _declared(path)
        for name, expected in (("flow", (height, width, 2)), ("mask", (height, width))):
            if name not in shapes:
                raise problem(path, f'has no array "{name}"; expected "flow" and "mask"')
            if shapes[name] != expected:
                raise problem(
                    path, f'"{name}" has shape {shapes[name]}, expected {expected} as the image '
                    "has before downscaling; compute the flow again, or set data.flow=none",
                )
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            vectors = np.asarray(arrays["flow"]).astype(np.float32)
            valid = np.asarray(arrays["mask"]) > 0.5
    except UNREADABLE as error:
        raise problem(
            path, f"not a readable npz ({error}); compute the flow again, or set data.flow=none"
        ) from None
    valid = valid & np.isfinite(vectors).all(axis=-1)
    return np.where(valid[..., None], vectors, np.float32(0)), valid


def read_flow(
    folder: Path,
    index: Sequence[int],
    expected: Sequence[bool],
    source_size: tuple[int, int],
    size: tuple[int, int],
) -> OpticalFlow | None:
    """The backward flow of N images.

    Args:
        folder: where the ``<index>_bwd.npz`` lie.
        index: N positions in the list of frames, which the files are numbered by.
        expected: N flags: whether the image has an earlier frame, and so a file.
        source_size: (width, height) of the images before downscaling.
        size: (width, height) after downscaling.

    Returns:
        Flow in pixels of the smaller images, or None when not one expected file is there.

    Raises:
        DevrfError: what :func:`read_flow_file` raises.
    """
    files = {
        row: folder / f"{number:03d}_bwd.npz"
        for row, (number, wanted) in enumerate(zip(index, expected, strict=True))
        if wanted
    }
    present = {row: path for row, path in files.items() if path.is_file()}
    if not present:
        log.info("no optical flow: no NNN_bwd.npz in %s", folder)
        return None
    if len(present) < len(files):
        log.warning(
            "%d of %d flow files are missing in %s; those images go without flow",
            len(files) - len(present), len(files), folder,
        )
    return stacked_flow(present, len(index), source_size, size)


def stacked_flow(
    files: Mapping[int, Path], count: int, source_size: tuple[int, int], size: tuple[int, int]
) -> OpticalFlow:
    """The backward flow of ``count`` images; those without a file have none.

    Args:
        files: which image's flow is in which file; at least one.
        count: how many images there are.
        source_size: (width, height) of the images before downscaling.
        size: (width, height) after downscaling.

    Returns:
        Flow in pixels of the smaller images.

    Raises:
        DevrfError: what :func:`read_flow_file` raises.
    """
    start = time.perf_counter()
    width, height = size
    vectors = np.zeros((count, height, width, 2), dtype=np.float32)
    valid = np.zeros((count, height, width), dtype=np.bool_)

    def fill(row: int) -> None:
        flow, mask = read_flow_file(files[row], *source_size)
        if size != source_size:
            flow, mask = shrink_flow(flow, mask, width, height)
        vectors[row], valid[row] = flow, mask

    with ThreadPoolExecutor(workers()) as pool:
        for _ in pool.map(fill, files):
            pass
    log.info(
        "read %d flow files from %s in %.1f s",
        len(files), next(iter(files.values())).parent, time.perf_counter() - start,
    )
    return OpticalFlow(torch.from_numpy(vectors), torch.from_numpy(valid))
