"""One picture of a learned scene, in any size, and how far away what it shows is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from devrf.artifacts.film import depth_picture
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene


@dataclass(frozen=True)
class StillSettings:
    """What is pictured.

    Attributes:
        view: ``held_out`` for the first held-out camera of the moving scene, or the number of an
            image of the static training set for that image's camera.
        time: in [0, 1]; 0 is the rest state.
        height: pixels; None for the captured images' height.
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

    def camera(self, scene: Scene) -> Cameras:
        """The one camera that is meant, with images of the height that is.

        Raises:
            DevrfError: the scene has no such camera.
        """
        captured = scene.dynamic.test if self.view == "held_out" else scene.static.train
        index = 0 if self.view == "held_out" else self.view
        if not 0 <= index < len(captured):
            some = f"expected held_out or 0 to {len(scene.static.train) - 1}, not {self.view}"
            raise DevrfError(f"still.view: {some}")
        camera = captured.cameras[[index]]
        return camera if self.height is None else camera.of_height(self.height)


def still(
    player: Renderer, camera: Cameras, time: float, background: float
) -> tuple[Tensor, Tensor]:
    """Colour (H, W, 3) and depth as colours (H, W, 3) of what one camera sees, in [0, 1].

    Args:
        player: shows the scene.
        camera: one camera.
        time: in [0, 1].
        background: grey level.
    """
    seen = player.view(camera, 0, time, background)
    depth = depth_picture(player.model, seen, camera.positions[0], camera.height)
    return seen.color.view(depth.shape).clamp(0, 1).cpu(), depth
