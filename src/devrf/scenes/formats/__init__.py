"""Which layout a scene's folder has, told by the files that are there."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path

from devrf.scenes.files import entries, scene_folder
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class KnownLayout:
    """A layout that a reader reads.

    Attributes:
        choice: the option of ``data=`` whose reader reads it.
        name: whose layout it is.
        files: what has to be there, relative to the scene's folder; ``*`` stands for any text.
    """

    choice: str
    name: str
    files: tuple[str, ...]

    def missing(self, root: Path) -> list[str]:
        """Those of ``files`` that are not in ``root``."""
        return [name for name in self.files if not any(map(os.path.isfile, root.glob(name)))]


# Folders that hold files of several layouts have that of the first: of two captures before one,
# of what says more about its images before what says less.
LAYOUTS = (
    KnownLayout("dycheck", "DyCheck", ("splits/train.json", "scene.json")),
    KnownLayout("nerfies", "Nerfies", ("dataset.json", "scene.json")),
    KnownLayout("inward", "DeVRF", ("static/transforms_train.json",)),
    KnownLayout("forward", "DeVRF forward", ("static/poses_bounds.npy",)),
    KnownLayout("nerfstudio", "nerfstudio", ("static/transforms.json",)),
    KnownLayout("inward", "D-NeRF, NeRF-synthetic", ("transforms_train.json",)),
    KnownLayout("nerfstudio", "nerfstudio, instant-ngp", ("transforms.json",)),
    KnownLayout("neural_3d_video", "Neural 3D Video", ("poses_bounds.npy", "cam*.mp4")),
    KnownLayout("forward", "NR-NeRF", ("poses_bounds.npy", "precomputed.json")),
    KnownLayout("colmap", "COLMAP", ("sparse/**/cameras.*",)),
    KnownLayout("forward", "LLFF", ("poses_bounds.npy",)),
)


def recognise(root: str | Path) -> KnownLayout:
    """The layout of the scene in ``root``; if none fits, DevrfError says what each lacks."""
    folder = scene_folder(root)
    fitting = [layout for layout in LAYOUTS if not layout.missing(folder)]
    if not fitting:
        raise scene_error(folder, f"no known layout ({_lacks(folder)}); {_advice(folder)}")
    chosen = fitting[0]
    others = sorted({layout.choice for layout in fitting} - {chosen.choice})
    also = f"; it would fit data={' and data='.join(others)} too" if others else ""
    log.info("%s: the layout of %s (data=%s)%s", folder, chosen.name, chosen.choice, also)
    return chosen


def _lacks(folder: Path) -> str:
    """What each layout lacks; of layouts that begin alike, the one that lacks the least."""
    missing = {one.name: set(one.missing(folder)) for one in LAYOUTS}
    least = [one for one in LAYOUTS if not any(m < missing[one.name] for m in missing.values())]
    return "; ".join(f"{one.name}: no {', '.join(one.missing(folder))}" for one in least)


def _advice(folder: Path) -> str:
    """What to do about a folder of unknown layout: scenes may lie right below it."""
    for path in entries(folder):
        if os.path.isdir(path) and any(not layout.missing(path) for layout in LAYOUTS):
            return f"{path.name}/ in it is a scene: give data.root that folder"
    return "set data.root to the scene's folder"
