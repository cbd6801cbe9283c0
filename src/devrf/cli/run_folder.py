"""Removes the folder of a run that ends in a user error before it has made anything."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from devrf.cli.messages import is_user_error
from devrf.cli.run_lock import PLACE

# Made in the folder before the config is checked.
AT_FIRST = {".hydra", PLACE}


@contextmanager
def removed_on_user_error(folder: Path) -> Iterator[None]:
    """Remove ``folder`` if the run ends in a user error and the folder holds no results."""
    was_new = _holds_at_most(folder, AT_FIRST)
    try:
        yield
    except Exception as error:
        if was_new and is_user_error(error):
            remove_if_only(folder, {*AT_FIRST, "run.log"})
        raise


def remove_if_only(folder: Path, names: set[str]) -> None:
    """Remove ``folder`` if it holds nothing but ``names``, and then empty parents.

    The working folder and all above it stay; so do the parents of a folder elsewhere.
    """
    if not _holds_at_most(folder, names):
        return
    for handler in list(logging.getLogger().handlers):
        if isinstance(handler, logging.FileHandler):
            logging.getLogger().removeHandler(handler)
            handler.close()
    for path in map(folder.joinpath, names):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    here, folder = Path.cwd(), folder.resolve()
    if here.is_relative_to(folder):
        return
    for path in [folder, *(path for path in folder.parents if here in path.parents)]:
        if any(path.iterdir()):
            break
        path.rmdir()


def _holds_at_most(folder: Path, names: set[str]) -> bool:
    return folder.is_dir() and {path.name for path in folder.iterdir()} <= names
