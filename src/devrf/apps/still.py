"""Pictures of a learned scene from one camera."""

from __future__ import annotations

import logging
from itertools import count
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import pydantic.dataclasses
from annotated_types import Ge, Le
from torch import Tensor

from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.pictures.images import (
    depth_colors,
    write_image,
)
from devrf.rendering.renderer import Renderer
from devrf.system.options import Options, Share

log = logging.getLogger(__name__)

# Pictures of small images are rendered at this height, in pixels, unless another is asked for.
READABLE = 400
# The most rows of a picture that may be asked for.
MAX_ROWS = 8192
DEPTH = "depth: near is bright"


@pydantic.dataclasses.dataclass(frozen=True)
class StillSettings(Options):
    """Settings of ``stage=still``; ``conf/still/default.yaml`` says what each does."""

    key: ClassVar[str] = "still"

    view: Literal["held_out"] | int = "held_out"
    time: Share = 0.5
    height: Annotated[int, Ge(1), Le(MAX_ROWS)] | None = None

    def name(self, moves: bool) -> str:
        """The name of the image's file, without its suffix: ``still_held_out_t0.5_h800``.

        It has no time if the scene never ``moves``.
        """
        time = f"_t{self.time:g}" if moves else ""
        size = "" if self.height is None else f"_h{self.height}"
        return f"still_{self.view}{time}{size}"

    def camera(self, viewpoints: Viewpoints) -> Cameras:
        """The chosen camera, with images of the chosen height.

        Raises:
            DevrfError: the scene has no such camera.
        """
        captured = viewpoints.held_out
        index = 0
        if isinstance(self.view, int):
            captured = viewpoints.static
            index = self.view
        if not 0 <= index < len(captured):
            raise DevrfError(
                f"still.view: expected held_out or 0 to {len(viewpoints.static) - 1}, "
                f"not {self.view}"
            )
        return sized(captured[[index]], self.height)


def sized(cameras: Cameras, height: int | None) -> Cameras:
    """The cameras with images ``height`` pixels high; None: as high as they are, at least 400.

    Images of several sizes become those of the commonest.
    """
    cameras = cameras.of_commonest_size()
    return cameras.of_height(max(cameras.height, READABLE) if height is None else height)


def still(
    renderer: Renderer,
    cameras: Cameras,
    time: float,
    background: float,
    index: int = 0,
    crop: Box | None = None,
) -> tuple[Tensor, Tensor]:
    """Colour (H, W, 3) and depth as colours (H, W, 3) of what camera ``index`` sees, in [0, 1].

    They are of the size of that camera's image. ``background`` is a grey level; what is outside a
    ``crop`` is left out.
    """
    model = renderer.model
    camera = cameras.single(index)
    shape = (camera.height, camera.width)
    image = renderer.view(camera, 0, time, background, crop)
    near, far = model.space.depth_range(model.box, model.depth_limits, camera.positions[0])
    depth = image.depth.view(shape).cpu()
    opacity = image.opacity.view(shape).cpu()
    color = image.color.view(*shape, 3).clamp(0, 1).cpu()
    return color, depth_colors(depth, opacity, near, far)


def write_still(path: Path, color: Tensor, depth: Tensor) -> None:
    """Write a picture and its ``<name>_depth``, with a number where files of that name are."""
    names = (path.with_stem(f"{path.stem}_{k}") for k in count(2))
    free = path if not path.exists() else next(name for name in names if not name.exists())
    for place, image in ((free, color), (free.with_stem(f"{free.stem}_depth"), depth)):
        write_image(place, image)
        log.info("picture written to %s", place)
