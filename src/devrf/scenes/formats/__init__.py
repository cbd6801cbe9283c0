"""The layout of a scene's folder, by its files."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from devrf.errors import DevrfError
from devrf.scenes.files import ARCHIVES, entries, scene_folder
from devrf.scenes.footage import VIDEOS
from devrf.scenes.images import SUFFIXES, unread
from devrf.scenes.sparse_model import PARTS, model_folders
from devrf.scenes.validation import scene_error
from devrf.system.override import to_type


@dataclass(frozen=True)
class KnownLayout:
    """A layout that a reader reads.

    Attributes:
        choice: the option of ``data=`` whose reader reads it.
        name: the program or data set that it is of.
        files: necessary files, relative to the scene's folder; ``*`` stands for any text.
        remark: other contents of a folder of this layout, in words, or empty.
    """

    choice: str
    name: str
    files: tuple[str, ...]
    remark: str = ""

    def missing(self, root: Path) -> list[str]:
        """The ``files`` that are not in ``root``."""
        return [name for name in self.files if not any(map(os.path.isfile, root.glob(name)))]


def _in_any_case(suffix: str) -> str:
    """A pattern of the suffix in letters of any size."""
    return "".join(f"[{letter}{letter.upper()}]" for letter in suffix)


# Other places and forms of models are in model_folders.
COLMAP = KnownLayout("colmap", "COLMAP", tuple(f"sparse/0/{part}.bin" for part in PARTS))
# A folder with files of several layouts has the first of them: layouts of two captures come before
# those of one, and files with more about the images before files with less.
LAYOUTS = (
    KnownLayout("dycheck", "DyCheck", ("splits/train.json", "scene.json")),
    KnownLayout("nerfies", "Nerfies", ("dataset.json", "scene.json")),
    KnownLayout("panoptic", "Dynamic 3D Gaussians", ("train_meta.json", "test_meta.json")),
    KnownLayout("easyvolcap", "EasyVolcap", ("intri.yml", "extri.yml")),
    KnownLayout("inward", "DeVRF", ("static/transforms_train.json",)),
    KnownLayout("forward", "DeVRF forward", ("static/poses_bounds.npy",)),
    KnownLayout("nerfstudio", "nerfstudio", ("static/transforms.json",)),
    KnownLayout("inward", "D-NeRF, NeRF-synthetic", ("transforms_train.json",)),
    KnownLayout("nerfstudio", "nerfstudio, instant-ngp", ("transforms.json",)),
    *(
        KnownLayout("neural_3d_video", "Neural 3D Video", ("poses_bounds.npy", f"cam[0-9]*{kind}"))
        for kind in ("/*", "/images/*", *map(_in_any_case, VIDEOS))
    ),
    KnownLayout("forward", "NR-NeRF", ("precomputed.json",)),
    COLMAP,
    KnownLayout("forward", "LLFF", ("poses_bounds.npy",)),
)


def recognise(root: str | Path) -> KnownLayout:
    """The layout of the scene in ``root``; DevrfError with the remedy if none fits."""
    folder, fitting = _fitting(root)
    layout = fitting[0]
    others = sorted({other.choice for other in fitting} - {layout.choice})
    also = f"; it would fit data={' and data='.join(others)} too" if others else ""
    if COLMAP not in fitting and (file := model_folders(folder).lacks):
        also += f"; its sparse/ is incomplete, no {file.relative_to(folder)}: left alone"
    return replace(layout, remark=also)


def check_choice(root: str | Path, choice: str) -> None:
    """DevrfError that names the right option, if ``data=choice`` does not read such a folder."""
    folder, fitting = _fitting(root)
    if choice == COLMAP.choice:
        model_folders(folder).check()
    if all(layout.choice != choice for layout in fitting):
        layout = fitting[0]
        raise scene_error(
            folder,
            f"has the files of {layout.name}, which data={choice} does not read; write "
            f"data={layout.choice}, or leave data= out",
        )


def _fitting(root: str | Path) -> tuple[Path, list[KnownLayout]]:
    """The scene's folder, and its layouts, at least one."""
    file = Path(os.path.expanduser(root))
    if file.suffix.lower() in VIDEOS and os.path.isfile(file):
        raise _footage(file, file)
    folder = scene_folder(root)
    fitting = _layouts(folder)
    if not fitting:
        model_folders(folder).check()
        raise _of_no_layout(folder)
    return folder, fitting


def _layouts(folder: Path) -> list[KnownLayout]:
    """The layouts of a folder, the preferred one first; installed packages' come before."""
    return [layout for layout in (*_installed(), *LAYOUTS) if _fits(layout, folder)]


@cache  # it takes ten times as long as a look at a folder
def _installed() -> tuple[KnownLayout, ...]:
    return tuple(point.load() for point in entry_points(group="devrf.layouts"))


def _fits(layout: KnownLayout, folder: Path) -> bool:
    if layout is COLMAP:
        return bool(model_folders(folder).whole)
    return not layout.missing(folder)


def _of_no_layout(folder: Path) -> DevrfError:
    """The remedy for a folder of no known layout: scenes, images or videos may be around it."""
    above = folder.absolute().parent
    inside = entries(folder)
    if _layouts(above):
        return scene_error(folder, "is a part of a scene; write", to_type("data.root", above))
    for path in inside:
        if os.path.isdir(path) and _layouts(path):
            word = to_type("data.root", path)
            return scene_error(folder, f"{path.name}/ in it is a scene; write", word)
    for images in (folder, folder / "images"):
        if os.path.isdir(images) and any(p.suffix.lower() in SUFFIXES for p in entries(images)):
            return _footage(folder, images)
    if videos := [path for path in inside if path.suffix.lower() in VIDEOS]:
        return _footage(folder, *videos)
    for images in (folder, folder / "images"):
        if os.path.isdir(images) and (kinds := unread(images)):
            return scene_error(images, f"no known layout, and no images that are read{kinds}")
    if packed := [path for path in inside if path.suffix.lower() in ARCHIVES]:
        return scene_error(packed[0], "is an archive; unpack it, and set data.root to its folder")
    # A layout is left out if another one lacks only some of the same files.
    missing = [layout.missing(folder) for layout in LAYOUTS]
    lacks = [files[0] for files in missing if not any({*f} < {*files} for f in missing)]
    expected = ", ".join(dict.fromkeys(lacks))
    return scene_error(
        folder, f"no known layout: has none of {expected}; set data.root to the scene's folder"
    )


def _footage(where: Path, static: Path, *views: Path) -> DevrfError:
    """The command that makes a scene of photographs or videos, the first one of them static."""
    name = static.parent.name if static.name == "images" else static.stem
    words = [to_type("capture.static", static)]
    words += [to_type("capture.views", views)] if views else []
    words.append(to_type("capture.into", Path("scenes", name or "mine")))
    typed = f"stage=capture {' '.join(words)}"
    if static.suffix.lower() in VIDEOS and not views:
        moving = to_type("capture.views", [static])
        typed += f", or with {moving} in place of capture.static if things move"
    return scene_error(where, "footage without camera poses; make a scene of it:", typed)
