"""Writing a scene to disk: a folder that is whole or absent, and the order of its images."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from devrf.scenes.scene import Views
from devrf.scenes.validation import scene_error

_WRITE_HINT = "give data.export another folder"


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A folder to write into that becomes ``folder`` at the end, if nothing fails.

    Args:
        folder: a new or an empty folder; folders above it are made.

    Raises:
        DevrfError: it is in use, or it cannot be written.
    """
    folder = folder.expanduser().absolute()
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise scene_error(folder, f"is there already and not an empty folder; {_WRITE_HINT}")
    partial = folder.with_name(f".{folder.name}.partial-{os.getpid()}")
    try:
        partial.mkdir(parents=True)
        yield partial
        partial.rename(folder)
    except OSError as error:
        raise scene_error(folder, f"cannot be written ({error}); {_WRITE_HINT}") from error
    finally:
        # After the renaming there is nothing left to remove.
        shutil.rmtree(partial, ignore_errors=True)


def time_major(views: Views) -> Views:
    """The views in order of time; those of one time in order of their cameras."""
    by_view = torch.argsort(views.view, stable=True)
    return views[by_view[torch.argsort(views.times[by_view], stable=True)]]
