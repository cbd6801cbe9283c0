"""What Neural Volumes asks of a scene, and the images that its encoder reads."""

from __future__ import annotations

from torch import Tensor

from devrf.errors import DevrfError
from devrf.methods.neural_volumes.encoder import cameras_of_every_frame, moment_images
from devrf.methods.neural_volumes.settings import KEY, NeuralVolumesSettings
from devrf.scenes.scene import Scene


def check_scene(scene: Scene) -> None:
    """Check that a scene is an object in a cube that cameras surround, cut out by mattes.

    Raises:
        DevrfError: it is not.
    """
    if scene.kind == "forward":
        raise DevrfError(
            f"method: neural_volumes needs cameras around a cube, and {scene.name} is seen from "
            "one side; use another method"
        )
    if not scene.space.is_linear:
        raise DevrfError(
            f"method: neural_volumes needs a scene in a cube, and {scene.name} has no end; give "
            "images with alpha masks, or use another method"
        )
    for capture, views in (("static", scene.static.train), ("dynamic", scene.dynamic.train)):
        if not views.cut_out:
            raise DevrfError(
                f"method: neural_volumes needs a known background, and the {capture} images of "
                f"{scene.name} have no alpha masks; give images with alpha, or use another method"
            )


def encoder_images(scene: Scene, settings: NeuralVolumesSettings) -> Tensor:
    """The images of each frame by cameras that are spread over the rig: (T, K, 3, h, w) uint8.

    Raises:
        DevrfError: too few fixed cameras have an image of every frame.
    """
    views, wanted = scene.dynamic.train, settings.encoder_views
    cameras = cameras_of_every_frame(views)
    if len(cameras) < wanted:
        raise DevrfError(
            f"{KEY}.encoder_views: expected {wanted} fixed training cameras with an image of every "
            f"frame, and {scene.name} has {len(cameras)}; set it no higher, or give more cameras"
        )
    last = max(wanted - 1, 1)
    chosen = [cameras[k * (len(cameras) - 1) // last] for k in range(wanted)]
    behind = 0.0 if scene.background == "black" else 1.0
    return moment_images(views, chosen, len(scene.clock), settings.encoder_size, behind)
