"""What one camera sees of a learned scene: colour, and depth as colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from devrf.apps.colors import depth_colors
from devrf.checkpoints.viewpoints import Viewpoints
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer

# Pictures of small images are rendered at this height, in pixels, unless another is asked for.
READABLE = 400


@dataclass(frozen=True)
class StillSettings:
    """The image that ``stage=still`` renders.

    Attributes:
        view: ``held_out`` for the first held-out camera of the moving scene, or the number of an
            image of the static training set for that image's camera.
        time: in [0, 1]; 0 is the rest state.
        height: pixels; None for the captured images' height, but at least 400.
        half: whether the colour network works in half precision, on a CUDA device only.
    """

    view: Literal["held_out"] | int = "held_out"
    time: float = 0.5
    height: int | None = None
    half: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.time <= 1:
            raise DevrfError(f"still.time: expected 0 to 1, not {self.time}")
        if self.height is not None and self.height < 1:
            raise DevrfError(f"still.height: expected at least 1, not {self.height}")

    @property
    def name(self) -> str:
        """What the image's file is called, without its suffix: ``still_held_out_t0.5_h800``."""
        size = "" if self.height is None else f"_h{self.height}"
        return f"still_{self.view}_t{self.time:g}{size}"

    def camera(self, viewpoints: Viewpoints) -> Cameras:
        """The chosen camera, with images of the chosen height.

        Raises:
            DevrfError: the scene has no such camera.
        """
        captured, index = viewpoints.held_out, 0
        if isinstance(self.view, int):
            captured, index = viewpoints.static, self.view
        if not 0 <= index < len(captured):
            some = f"expected held_out or 0 to {len(viewpoints.static) - 1}, not {self.view}"
            raise DevrfError(f"still.view: {some}")
        return sized(captured[[index]], self.height)


def sized(cameras: Cameras, height: int | None) -> Cameras:
    """The cameras with images ``height`` pixels high; None: as high as they are, at least 400."""
    return cameras.of_height(max(cameras.height, READABLE) if height is None else height)


def still(
    renderer: Renderer,
    cameras: Cameras,
    time: float,
    background: float,
    index: int = 0,
    crop: Box | None = None,
) -> tuple[Tensor, Tensor]:
    """Colour (H, W, 3) and depth as colours (H, W, 3) of what a camera sees, in [0, 1].

    Args:
        renderer: of the learned scene.
        cameras: of which camera ``index`` is used.
        time: in [0, 1].
        background: grey level.
        index: which of the cameras.
        crop: what is outside this box is left out.
    """
    model, shape = renderer.model, (cameras.height, cameras.width)
    image = renderer.view(cameras, index, time, background, crop)
    near, far = model.space.depth_range(model.box, model.depth_limits, cameras.positions[index])
    depth, opacity = image.depth.view(shape).cpu(), image.opacity.view(shape).cpu()
    color = image.color.view(*shape, 3).clamp(0, 1).cpu()
    return color, depth_colors(depth, opacity, near, far)
