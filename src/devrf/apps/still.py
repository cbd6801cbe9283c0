"""What one camera sees of a learned scene: pictures, previews, contact sheets."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from textwrap import wrap
from typing import Annotated, ClassVar, Literal, NamedTuple

import pydantic.dataclasses
import torch
from annotated_types import Ge, Le
from torch import Tensor

from devrf.apps.images import (
    depth_colors,
    error_colors,
    evenly,
    image_grid,
    scaled,
    short_name,
    side_by_side,
    write_image,
)
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.evaluation.held_out import HeldOutView, background_value, compare, exposed, truth_image
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.metrics.image import psnr
from devrf.rendering.renderer import Renderer
from devrf.rendering.view import Viewable
from devrf.scenes.scene import Background, Views
from devrf.system.options import Options, Share

log = logging.getLogger(__name__)

# Pictures of small images are rendered at this height, in pixels, unless another is asked for.
READABLE = 400
# The most rows of a picture that may be asked for.
MAX_ROWS = 8192
# The least and the largest height of images in contact sheets; others are resized.
MIN_HEIGHT = 300
MAX_HEIGHT = 640
DEPTH = "depth: near is bright"
HEADINGS = ("truth", "rendered", "error: 0 to 0.25 or more", DEPTH)


@pydantic.dataclasses.dataclass(frozen=True)
class StillSettings(Options):
    """Settings of ``stage=still``; ``conf/still/default.yaml`` says what each does."""

    key: ClassVar[str] = "still"

    view: Literal["held_out"] | int = "held_out"
    time: Share = 0.5
    height: Annotated[int, Ge(1), Le(MAX_ROWS)] | None = None
    half: bool = True

    def name(self, moves: bool) -> str:
        """What the image's file is called, without its suffix: ``still_held_out_t0.5_h800``.

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


class Preview(NamedTuple):
    """A held-out view as rendered so far.

    ``images`` (H, W', 3) are in [0, 1]: ``view`` is beside the truth and the error, ``depth`` its
    depth. ``psnr`` in dB takes pixels that are not valid as right.
    """

    images: dict[str, Tensor]
    psnr: float


def preview(model: Viewable, views: Views, index: int, background: Background) -> Preview:
    """Render one of the held-out views, on the host, and compare it with the truth."""
    time = float(views.times[index])
    behind = background_value(background)
    prediction, depth = still(Renderer(model, times=1), views.cameras, time, behind, index)
    truth = truth_image(views, index, background).cpu()
    prediction = exposed(prediction, truth, views, index)
    compared = compare(prediction, truth, views.valid_mask_of(index))
    shown = side_by_side([prediction, truth, error_colors(compared, truth)])
    return Preview({"view": shown, "depth": depth}, psnr(compared, truth))


def write_contact_sheet(path: Path, views: Sequence[HeldOutView], rows: int = 6) -> Tensor:
    """Write a PNG of ``rows`` of the views with name, time and scores; the sheet (H, W, 3), uint8.

    Times are left out if all are 0.
    """
    shown = [views[k] for k in evenly(len(views), rows)]
    near, far = _depth_range(shown)
    height = min(max(shown[0].truth.shape[0], MIN_HEIGHT), MAX_HEIGHT)
    rows_of_tiles = []
    labels = []
    for view in shown:
        error = error_colors(view.compared, view.truth)
        depth = depth_colors(view.depth, view.opacity, near, far)
        tiles = (view.truth, view.prediction, error, depth)
        rows_of_tiles.append([scaled(tile, height) for tile in tiles])
        name = wrap(short_name(view.name), 16, break_long_words=False, break_on_hyphens=False)
        scores = (f"PSNR {view.psnr:.2f} dB", f"SSIM {view.ssim:.3f}")
        time = [f"time {view.time:.2f}"] if any(view.time for view in views) else []
        labels.append([*name, *time, *scores])
    sheet = image_grid(rows_of_tiles, HEADINGS, labels)
    write_image(path, sheet)
    return sheet


def _depth_range(views: Sequence[HeldOutView]) -> tuple[float, float]:
    """The nearest and furthest depth of what is solid in the views, but for a hundredth each."""
    order = torch.cat([view.depth[view.opacity > 0.5] for view in views]).sort().values
    if len(order) == 0:
        return 0.0, 1.0
    margin = (len(order) - 1) // 100
    near = float(order[margin])
    far = float(order[-1 - margin])
    return near, max(far, near + 1e-6)
