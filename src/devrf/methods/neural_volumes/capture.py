"""Requirements of Neural Volumes on a scene, and the images that its encoder reads."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.errors import DevrfError
from devrf.evaluation.held_out import truth_image
from devrf.methods.neural_volumes.settings import NeuralVolumesSettings
from devrf.scenes.scene import Scene, Views, background_value


def check_scene(scene: Scene) -> None:
    """Check that a scene is an object in a cube that cameras surround, cut out by alpha masks.

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
            f"method: neural_volumes needs a scene in a cube, and {scene.name} is unbounded; give "
            "images with alpha masks, or use another method"
        )
    for name, capture in (("static", scene.static), ("dynamic", scene.dynamic)):
        # With priors=none masks are kept from methods, but the background is known.
        if not (capture.train.cut_out or capture.test.cut_out):
            raise DevrfError(
                f"method: neural_volumes needs a known background, and the {name} images of "
                f"{scene.name} have no alpha masks; give images with alpha, or use another method"
            )


def encoder_images(scene: Scene, settings: NeuralVolumesSettings) -> Tensor:
    """The images of each frame by cameras that are spread over the rig, on the host.

    Images larger than the encoder's are made smaller; the background fills the rest. A frame that
    no camera has (time 0 of a capture that begins later) gets the images of the next one.

    Returns:
        (T, K, 3, h, w) uint8.

    Raises:
        DevrfError: too few fixed cameras have an image of every frame.
    """
    views = scene.dynamic.train
    wanted = settings.encoder_views
    assert views.frames is not None
    cameras = cameras_of_every_frame(views)
    expected = (
        f"at most {len(cameras)}, as {scene.name} has so many fixed training cameras with an "
    )
    settings.check("encoder_views", wanted <= len(cameras), expected + "image of every frame")
    height, width = settings.encoder_size
    behind = round(255 * background_value(scene.background))
    images = torch.full((len(scene.clock), wanted, 3, height, width), behind, dtype=torch.uint8)
    for k in range(wanted):
        camera = cameras[k * (len(cameras) - 1) // max(wanted - 1, 1)]
        for index in (views.view == camera).nonzero()[:, 0].tolist():
            color = truth_image(views, index, scene.background).permute(2, 0, 1)
            scale = min(1.0, height / color.shape[1], width / color.shape[2])
            rows = round(color.shape[1] * scale)
            columns = round(color.shape[2] * scale)
            top = (height - rows) // 2
            left = (width - columns) // 2
            if scale < 1:
                color = nn.functional.interpolate(
                    color[None], (rows, columns), mode="bilinear", antialias=True
                )[0]
            target = images[int(views.frames[index]), k, :, top : top + rows, left : left + columns]
            target.copy_((255 * color).round().clamp(0, 255))
    first = int(views.frames.min())
    images[:first] = images[first]
    return images


def cameras_of_every_frame(views: Views) -> list[int]:
    """The fixed cameras that have an image of each frame that any camera has."""
    assert views.frames is not None
    frames_of: dict[int, set[int]] = {}
    for camera, frame in zip(views.view.tolist(), views.frames.tolist(), strict=True):
        frames_of.setdefault(camera, set()).add(frame)
    all_frames = set().union(*frames_of.values())
    return sorted(camera for camera, frames in frames_of.items() if frames == all_frames)
