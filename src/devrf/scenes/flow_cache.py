"""Estimated optical flow kept in a file, and known by the images it came from."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch

from devrf.scenes.scene import OpticalFlow, Views
from devrf.scenes.validation import problem

log = logging.getLogger(__name__)

# Part of the key: a change of the estimate makes earlier files foreign.
VERSION = "1"
UNREADABLE = (
    OSError, ValueError, TypeError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile,
    zlib.error,
)


def content_key(views: Views, method: str) -> str:
    """A hash of everything that the flow of ``views`` depends on."""
    digest = hashlib.sha256(f"{VERSION} {method} {tuple(views.pixels.shape)}".encode())
    for part in (views.pixels, views.times, views.view):
        digest.update(part.cpu().contiguous().numpy().data)
    return digest.hexdigest()


def load_flow(path: Path, key: str, shape: tuple[int, int, int]) -> OpticalFlow | None:
    """The flow stored at ``path``, or None when there is none for these images.

    Args:
        path: an npz written by :func:`save_flow`.
        key: the :func:`content_key` that it must carry.
        shape: (N, H, W) that it must have.
    """
    if not path.is_file():
        return None
    try:
        # Opened here: given a path, np.load leaves a damaged file open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            if str(stored["key"]) != key:
                log.info("%s holds the flow of other images or of another method", path)
                return None
            vectors = torch.from_numpy(stored["vectors"])
            valid = torch.from_numpy(stored["valid"])
    except UNREADABLE as error:
        log.warning("%s is damaged (%s): the flow is estimated again", path, error)
        return None
    if vectors.shape != (*shape, 2) or valid.shape != shape or valid.dtype != torch.bool:
        log.warning("%s is damaged (wrong shapes): the flow is estimated again", path)
        return None
    return OpticalFlow(vectors.float(), valid)


def save_flow(path: Path, key: str, flow: OpticalFlow) -> None:
    """Write ``flow`` to ``path`` at once: a reader sees the whole file or none.

    Raises:
        DevrfError: the file cannot be written.
    """
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            dir=path.parent, prefix=f".{path.name}.", delete=False
        ) as file:
            temporary = Path(file.name)
            np.savez_compressed(
                file, key=np.array(key), vectors=flow.vectors.numpy(), valid=flow.valid.numpy()
            )
        os.replace(temporary, path)
    except OSError as error:
        raise problem(path, f"cannot write the flow ({error}); choose another folder") from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
