"""Which of a scene's folders holds the capture of the moving scene."""

from __future__ import annotations

import fnmatch
import os
from pathlib import Path

from devrf.scenes.paths import entries
from devrf.scenes.validation import scene_error


def dynamic_folders(root: Path) -> list[Path]:
    """The folders ``dynamic_<V>views`` of ``root``, in order of their names."""
    return [
        path
        for path in entries(root)
        if fnmatch.fnmatch(path.name, "dynamic_*views") and os.path.isdir(path)
    ]


def chosen_dynamic(root: Path, chosen: str | None) -> Path:
    """The one of :func:`dynamic_folders` called ``chosen``, or (None) the only one.

    Raises:
        DevrfError: there is none, none of that name, or several to choose from.
    """
    folders = dynamic_folders(root)
    names = ", ".join(folder.name for folder in folders)
    if chosen is not None:
        named = [folder for folder in folders if folder.name == chosen]
        if not named:
            found = names or "none"
            raise scene_error(root, f"no folder {chosen!r} (found: {found}); correct data.dynamic")
        return named[0]
    if not folders:
        raise scene_error(root, "no folder dynamic_<V>views; add the capture of the moving scene")
    if len(folders) > 1:
        raise scene_error(root, f"several captures ({names}); choose one with data.dynamic=NAME")
    return folders[0]
