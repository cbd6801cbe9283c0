"""The folder of a run that came to nothing."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from devrf.cli.messages import is_user_error
from devrf.cli.run_lock import PLACE

# What is made in the folder before the program has had a look at its input.
AT_FIRST = {".hydra", PLACE}


@contextmanager
def nothing_left_of_mistakes(folder: Path) -> Iterator[None]:
    """Remove ``folder`` when the run ends in the user's mistake before it has made anything.

    A folder that holds the results of an earlier run, or a first result of this one, stays.
    Parents that are empty then go too, up to the working folder.
    """
    held_nothing = _holds_at_most(folder, AT_FIRST)
    try:
        yield
    except Exception as error:
        if is_user_error(error) and held_nothing:
            remove_if_only(folder, {*AT_FIRST, "run.log"})
        raise


def remove_if_only(folder: Path, names: set[str]) -> None:
    """Remove ``folder`` if it holds nothing but ``names``, and parents that are empty then."""
    if _holds_at_most(folder, names):
        _remove(folder, names)


def _holds_at_most(folder: Path, names: set[str]) -> bool:
    return folder.is_dir() and {path.name for path in folder.iterdir()} <= names


def _remove(folder: Path, names: set[str]) -> None:
    for handler in list(logging.getLogger().handlers):
        if isinstance(handler, logging.FileHandler):
            logging.getLogger().removeHandler(handler)
            handler.close()
    for path in map(folder.joinpath, names):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    here = Path.cwd()
    for path in (folder.resolve(), *folder.resolve().parents):
        # Nothing above a folder that lies elsewhere is ours, nor is the working folder.
        elsewhere = path != folder.resolve() and here not in path.parents
        if elsewhere or path == here or path in here.parents or any(path.iterdir()):
            break
        path.rmdir()
