"""A scene's kind, from its camera files, before anything else is read.

A damaged file counts as absent here: its reader reports it.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import torch

from devrf.errors import DevrfError
from devrf.geometry.offset import offset_of, subtracted
from devrf.scenes.files import read_json
from devrf.scenes.formats.dycheck import DycheckReader
from devrf.scenes.formats.llff_poses import PRECOMPUTED
from devrf.scenes.formats.nerfies import NerfiesReader
from devrf.scenes.sparse_model import ONE_SIDE, scene_model, widest_angle
from devrf.scenes.splits import are_fixed, distinct_poses, distinct_times
from devrf.scenes.transforms import TransformsFile
from devrf.scenes.view_folders import dynamic_folders


def faces_forward(choice: str, root: str | Path, space: str | None) -> bool:
    """Whether the scene in ``root`` is forward-facing, if its reader decides that by the files.

    Args:
        choice: the option of ``data=`` that reads it.
        root: the scene's folder.
        space: ``data.space``, None for its default.
    """
    if choice not in ("colmap", "nerfstudio") or space not in (None, "auto"):
        return space == "ndc"
    folder = Path(root).expanduser()
    if choice == "nerfstudio":
        listings = [_transforms(folder / part / "transforms.json") for part in ("", "static")]
        bounds = [listing.scene_bounds for listing in listings if listing is not None]
        return any(stated is not None and stated.space == "ndc" for stated in bounds)
    with suppress(DevrfError):
        return widest_angle(scene_model(folder)[0].poses) <= ONE_SIDE
    return False


def by_one_camera(choice: str, root: str | Path, *, ordered: bool = False) -> bool:
    """Whether one moving camera takes all images while time passes: there is no static set.

    ``ordered``: the times are in the order of the names (``data.times=order``).
    """
    folder = Path(root).expanduser()
    if choice in ("nerfies", "dycheck"):
        with suppress(DevrfError):
            reader = NerfiesReader(root) if choice == "nerfies" else DycheckReader(root)
            listed, learned, _ = reader.listed(folder)
            moments = reader.moments(folder, [listed[k] for k in learned])
            return len(distinct_times(torch.tensor(moments))) > 1
        return False
    if choice == "forward":
        return (folder / PRECOMPUTED).is_file() and not dynamic_folders(folder)
    file = {"inward": "transforms_train.json", "nerfstudio": "transforms.json"}.get(choice)
    listing = None if file is None else _transforms(folder / file)
    if listing is None:
        return False
    stated = [frame.time for frame in listing.frames if frame.time is not None]
    times = torch.arange(len(listing.frames)) if ordered else torch.tensor(stated)
    poses = torch.tensor(
        [frame.transform_matrix[:3] for frame in listing.frames], dtype=torch.float64
    )
    alone = 1 < len(times) == len(distinct_times(times))
    return alone and not are_fixed(distinct_poses(subtracted(poses, offset_of(poses)).float()))


def _transforms(file: Path) -> TransformsFile | None:
    """The content of a transforms file; None if it is absent or damaged."""
    with suppress(DevrfError):
        return read_json(file, TransformsFile, "it poses the images")
    return None
