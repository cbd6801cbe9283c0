"""What kind of scene a folder holds, told by its camera files, before anything else is read.

A damaged file says nothing here: its reader reports it.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import torch

from devrf.errors import DevrfError
from devrf.scenes.files import read_json
from devrf.scenes.formats import recognise
from devrf.scenes.sparse_model import ONE_SIDE, model_folder, read_model, widest_angle
from devrf.scenes.splits import distinct_poses, distinct_times, stand_still
from devrf.scenes.transforms import TransformsFile

# Options of ``data=`` whose scenes are forward-facing ones, whatever the files say.
FORWARD = {"forward", "neural_3d_video"}
# As D-NeRF's scenes are taken.
ONE_CAMERA = "one_camera"


def kind_of(choice: str, root: str | Path, space: str | None) -> list[str]:
    """Words for the scene in ``root``, the most telling first.

    Args:
        choice: the option of ``data=`` that reads it, or ``auto``.
        root: the scene's folder.
        space: ``data.space``, None for its default.

    Returns:
        The option of ``data=``; ``one_camera`` where it is of one camera, elsewhere in each image
        as time passes; ``forward`` or ``inward``, as cameras look at it.

    Raises:
        DevrfError: the layout is unknown.
    """
    choice = recognise(root).choice if choice == "auto" else choice
    folder = Path(root).expanduser()
    forward = choice in FORWARD or space == "ndc"
    if choice == "colmap" and space in (None, "auto"):
        with suppress(DevrfError):
            place = model_folder(folder)
            forward = place is not None and widest_angle(read_model(place).poses) <= ONE_SIDE
    elif choice == "nerfstudio" and space in (None, "auto"):
        files = [
            _transforms(folder / name) for name in ("transforms.json", "static/transforms.json")
        ]
        forward = any(f and f.scene_bounds and f.scene_bounds.space == "ndc" for f in files)
    alone = choice == "inward" and _by_one_camera(_transforms(folder / "transforms_train.json"))
    return [choice, *[ONE_CAMERA] * alone, "forward" if forward else "inward"]


def _transforms(file: Path) -> TransformsFile | None:
    """What a transforms file says; None where there is none, or a damaged one."""
    with suppress(DevrfError):
        return read_json(file, TransformsFile, "it poses the images")
    return None


def _by_one_camera(listing: TransformsFile | None) -> bool:
    """Whether images of several times are not from cameras that stand still."""
    if listing is None:
        return False
    times = torch.tensor([frame.time for frame in listing.frames if frame.time is not None])
    poses = torch.tensor([frame.transform_matrix[:3] for frame in listing.frames])
    return len(distinct_times(times)) > 1 and not stand_still(distinct_poses(poses))
