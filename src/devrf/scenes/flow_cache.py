"""Estimated optical flow kept in a file, and known by the images it came from."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from pathlib import Path

import numpy as np
import torch

from devrf.errors import DevrfError
from devrf.scenes.array_files import Form, read_archive
from devrf.scenes.scene import OpticalFlow, Views
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)

# Part of the key: a change of the estimate makes earlier files foreign.
VERSION = "2"


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
    if not os.path.isfile(path):
        return None
    forms = {"key": Form((), "U"), "vectors": Form((*shape, 2), "f"), "valid": Form(shape, "b")}
    try:
        stored = read_archive(path, forms, "the images explain", "it is written again")
    except DevrfError as error:
        log.warning("the flow is estimated again: %s", error)
        return None
    if str(stored["key"]) != key:
        log.info("%s holds the flow of other images or of another method", path)
        return None
    vectors = torch.from_numpy(stored["vectors"].astype(np.float32))
    if not bool(vectors.isfinite().all()):
        log.warning("the flow is estimated again: %s holds NaN or infinity", path)
        return None
    return OpticalFlow(vectors, torch.from_numpy(stored["valid"]))


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
        raise scene_error(path, f"cannot write the flow ({error}); choose another folder") from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
