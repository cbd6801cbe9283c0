"""Where a scene was seen from: what a picture of it needs beside the learned fields."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import Background, Scene


@dataclass(frozen=True)
class Viewpoints:
    """The cameras of a scene, without its images.

    Attributes:
        static: cameras of the static training images.
        held_out: the camera of the first held-out image of the moving scene: one camera.
        background: what is behind the matte.
    """

    static: Cameras
    held_out: Cameras
    background: Background

    @classmethod
    def of(cls, scene: Scene) -> Viewpoints:
        """The viewpoints of a scene."""
        return cls(scene.static.train.cameras, scene.dynamic.test.cameras[[0]], scene.background)

    def as_data(self) -> dict[str, Any]:
        """Plain data and tensors, for a checkpoint."""
        return asdict(self)


def viewpoints_in(path: Path, data: dict[str, Any]) -> Viewpoints | None:
    """The viewpoints in the content of a checkpoint; None where it has none.

    Raises:
        DevrfError: they have other entries.
    """
    found = data.get("viewpoints")
    if found is None:
        return None
    try:
        static, held_out = Cameras(**found["static"]), Cameras(**found["held_out"])
        background = found["background"]
    except (TypeError, LookupError) as error:
        raise DevrfError(f"{path}: its cameras are not as devrf writes them ({error})") from None
    if background not in get_args(Background):
        raise DevrfError(f"{path}: its background is {background!r}, which is not known")
    return Viewpoints(static, held_out, background)
