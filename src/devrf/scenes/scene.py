"""A scene, from any files: frozen, typed, on the host, uint8."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.geometry.offset import NO_OFFSET, Offset
from devrf.geometry.space import WORLD, Space

Background = Literal["white", "black", "random"]
CaptureName = Literal["static", "dynamic"]
# Training images: those of a capture, or all of the canonical state (Scene.at_rest).
ImagesName = Literal["static", "dynamic", "at_rest"]


def background_value(background: Background) -> float:
    """The grey level in [0, 1] of a background; a random one is white where nothing is learned."""
    return 0.0 if background == "black" else 1.0


def on_background(pixels: Tensor, behind: float | Tensor) -> Tensor:
    """Pixels (..., 3 or 4) uint8 as RGB (..., 3) in [0, 1], those with alpha on a colour."""
    value = pixels.float() / 255
    if value.shape[-1] == 3:
        return value
    return behind + value[..., 3:] * (value[..., :3] - behind)


@dataclass(frozen=True)
class OpticalFlow:
    """Optical flow of N images: backward, to one frame earlier in the same view.

    Forward flow leads to one frame later.

    Attributes:
        vectors: (N, H, W, 2) float32, pixels, x then y: (pixel one frame earlier) − (this pixel).
        valid: (N, H, W) bool; False where the flow is unknown or unreliable, and on all of an image
            without an earlier frame.
    """

    vectors: Tensor
    valid: Tensor


@dataclass(frozen=True)
class Views:
    """N posed images on one raster.

    Images smaller than the raster (``cameras.sizes``) are at its top left. Beside them pixels are
    opaque black, and not valid.

    Attributes:
        pixels: (N, H, W, 3 or 4) uint8, RGB or RGBA (alpha not premultiplied).
        cameras: N cameras on that raster, world units.
        times: (N,) float32 in [0, 1].
        view: (N,) int64, the fixed camera of each image (0 … V−1); in a static set, or for a moving
            camera, the image's own number.
        names: N file names or labels, for messages and tables.
        flow: backward optical flow, or None.
        forward_flow: forward optical flow; None if it is unknown, or no method needs it.
        depth: (N, H, W) float32 distance along each pixel's ray in world units, +inf where the
            ray hits nothing; None where it is unknown.
        ambiguous_orientation: (N,) bool, images that are read as they are stored although their
            EXIF orientation asks for a turn, which nothing confirms or refutes. None: none.
        valid_mask: (N, H, W) bool, the pixels that count in training and scores; the others are
            ignored. None: all of them.
        exposure_mask: (N, H, W) bool, the pixels of held-out images that determine the exposure of
            each. None: they have the training images' exposure.
        motion_mask: (N, H, W) bool, the pixels of held-out images that show what moves
            (docs/stages.md#moving). None: it is not known.
        frames: (N,) int64, the frame of the scene's clock that is nearest to each image's time;
            None until the images are those of a :class:`Scene`.
    """

    pixels: Tensor
    cameras: Cameras
    times: Tensor
    view: Tensor
    names: tuple[str, ...]
    flow: OpticalFlow | None = None
    forward_flow: OpticalFlow | None = None
    depth: Tensor | None = None
    ambiguous_orientation: Tensor | None = None
    valid_mask: Tensor | None = None
    exposure_mask: Tensor | None = None
    motion_mask: Tensor | None = None
    frames: Tensor | None = None

    def __len__(self) -> int:
        return self.pixels.shape[0]

    @property
    def width(self) -> int:
        """The raster's width in pixels."""
        return self.pixels.shape[2]

    @property
    def height(self) -> int:
        """The raster's height in pixels."""
        return self.pixels.shape[1]

    @property
    def has_alpha(self) -> bool:
        """Whether the images carry an alpha mask."""
        return self.pixels.shape[3] == 4

    @cached_property
    def cut_out(self) -> bool:
        """Whether the alpha masks leave out anything: some are not opaque."""
        return self.has_alpha and bool((self.pixels[..., 3] < 255).any())

    @property
    def by_moving_camera(self) -> bool:
        """Whether each image is its own view: the camera moved between all of them."""
        return len(set(self.view.tolist())) == len(self)

    def __getitem__(self, index: Tensor) -> Views:
        """The views at positions ``index`` (K,) int64."""
        return replace(
            self.mapped(lambda of_views: of_views[index]),
            names=tuple(self.names[i] for i in index.tolist()),
        )

    def single(self, image: int) -> Views:
        """One of the images alone, on a raster of its own size; nothing is copied.

        Among images of several sizes it has a ``valid_mask`` only if some pixels are not valid.
        """
        index = slice(image, image + 1)
        view = replace(self.mapped(lambda of_views: of_views[index]), names=self.names[index])
        if self.cameras.sizes is None:
            return view
        width, height = self.cameras.size_of(image)

        def cropped(of_views: Any) -> Any:
            of_pixels = isinstance(of_views, Tensor) and of_views.ndim > 2
            return of_views[:, :height, :width] if of_pixels else of_views

        view = replace(view.mapped(cropped), cameras=self.cameras.single(image))
        valid = view.valid_mask
        return replace(view, valid_mask=None) if valid is None or bool(valid.all()) else view

    def singles(self) -> Iterator[Views]:
        """Each of the images alone, see :meth:`single`."""
        return map(self.single, range(len(self)))

    def valid_mask_of(self, image: int) -> Tensor | None:
        """(H, W) bool on the host, the valid pixels of a :meth:`single` image; None: all."""
        valid_mask = self.single(image).valid_mask
        return None if valid_mask is None else valid_mask[0].cpu()

    def to(self, device: torch.device | str) -> Views:
        """The same views on ``device``; images stay uint8."""
        return self.mapped(lambda of_views: of_views.to(device))

    def mapped(self, change: Callable[[Any], Any]) -> Views:
        """The views with ``change`` made to all tensors and cameras."""
        changed: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, OpticalFlow):
                changed[field.name] = OpticalFlow(change(value.vectors), change(value.valid))
            elif value is not None and field.name != "names":
                changed[field.name] = change(value)
        return replace(self, **changed)


@dataclass(frozen=True)
class Capture:
    """One recording: training images and held-out images.

    Attributes:
        train: training views.
        test: held-out views.
        validation: held-out views for the choice of settings, none of them in ``test``; None if
            they are not used, or there are none.
        keypoints: (N, K, 3) of the training images: x and y of K points that move with the scene,
            in shares of the image's sides, and 1 where the image shows the point, else 0. None:
            no such points are known.
    """

    train: Views
    test: Views
    validation: Views | None = None
    keypoints: Tensor | None = None

    def mapped(self, change: Callable[[Views], Views]) -> Capture:
        """The capture with ``change`` made to all of its views."""
        validation = None if self.validation is None else change(self.validation)
        return Capture(change(self.train), change(self.test), validation, self.keypoints)


def both_mapped(
    static: Capture, dynamic: Capture, change: Callable[[Views], Views]
) -> tuple[Capture, Capture]:
    """Both captures with ``change`` made to all views, once to those that they share."""
    changed: dict[int, Views] = {}

    def once(views: Views) -> Views:
        if id(views) not in changed:
            changed[id(views)] = change(views)
        return changed[id(views)]

    return static.mapped(once), dynamic.mapped(once)


@dataclass(frozen=True)
class GivenBounds:
    """What options or files say of a scene's bounds; None: the cameras tell it.

    Attributes:
        scale: ``auto``: the room for motion is that of the silhouettes of alpha masks; without them
            it is the given box, or a fixed scale. A number: that of :class:`Bounds`; it makes the
            inner box of contracted space so much larger.
        near: distance in world units.
        far: distance in world units; contracted space is unbounded.
        box: the scene's box, world units.
    """

    scale: float | Literal["auto"] = "auto"
    near: float | None = None
    far: float | None = None
    box: Box | None = None


@dataclass(frozen=True)
class Bounds:
    """The bounds of a scene, in the space of its fields (world units, or NDC).

    Attributes:
        box: the box of the visible static scene (before it is tightened).
        near: least distance of the scene from a camera.
        far: largest distance of the scene from a camera.
        motion: the box of all that moves at any time; None if it is unknown: then the canonical
            box is enlarged by ``scale`` instead.
        scale: factor of the tightened canonical box, about its centre, that makes room for motion;
            not used when ``motion`` is known.
        source: the source of the motion box, in words, for the log.
        limited: whether motion has no more room than the box, which was given.
        given: what options or files said of them.
        reason: the reason for the scene's space, in words.
        box_source: the source of the box, in words.
    """

    box: Box
    near: float
    far: float
    motion: Box | None
    scale: float
    source: str
    limited: bool = False
    given: GivenBounds = GivenBounds()
    reason: str = ""
    box_source: str = ""

    @property
    def whole(self) -> Box:
        """The box of the static scene and all that moves."""
        return self.box if self.motion is None else self.box.union(self.motion)


@dataclass(frozen=True)
class Scene:
    """A static → dynamic capture, or a static one alone.

    Attributes:
        name: short name for folders and tables.
        kind: ``inward`` (cameras around the scene) or ``forward`` (cameras before it, NDC).
        static: many views of the canonical state (t = 0).
        dynamic: a few fixed views of the deforming scene; the static capture itself if the scene
            never moves. It alone has validation views.
        bounds: its bounds, in ``space``.
        background: the colour behind the alpha mask.
        space: the space of the fields.
        offset: the offset that was subtracted from all positions of the capture's world
            (:mod:`devrf.geometry.offset`); 0 near the origin.
    """

    name: str
    kind: Literal["inward", "forward"]
    static: Capture
    dynamic: Capture
    bounds: Bounds
    background: Background
    space: Space = WORLD
    offset: Offset = NO_OFFSET

    def __post_init__(self) -> None:
        clock = self.clock
        static, dynamic = both_mapped(
            self.static,
            self.dynamic,
            lambda views: replace(views, frames=clock.frames_of(views.times)),
        )
        object.__setattr__(self, "static", static)
        object.__setattr__(self, "dynamic", dynamic)

    @property
    def is_monocular(self) -> bool:
        """Whether one moving camera took all images: there is no static set.

        Images of the video stand in for it. Two captures may share only the fixed cameras' first
        images.
        """
        video = self.dynamic.train
        shared = not {*self.static.train.names}.isdisjoint(video.names)
        return shared and video.by_moving_camera

    @property
    def at_rest(self) -> Views:
        """The static training views and the first frames of the dynamic ones, at time 0.

        They are the static ones alone if the others have another size or a moving camera, or if
        only one of both sets has masks. An image with the pose of a static one is left out.
        """
        static = self.static.train
        moving = self.dynamic.train
        alike = static.pixels.shape[1:] == moving.pixels.shape[1:]
        masked = [views.valid_mask is not None for views in (static, moving)]
        if not alike or moving.by_moving_camera or masked[0] != masked[1]:
            return static
        assert static.frames is not None and moving.frames is not None
        first = moving[(moving.frames == 0).nonzero()[:, 0]]
        first_poses = first.cameras.camera_to_world.flatten(1)
        static_poses = static.cameras.camera_to_world.flatten(1)
        first = first[(torch.cdist(first_poses, static_poses) > 0).all(dim=1).nonzero()[:, 0]]
        assert first.frames is not None
        valid = [v.valid_mask for v in (static, first) if v.valid_mask is not None]
        return Views(
            pixels=torch.cat([static.pixels, first.pixels]),
            cameras=static.cameras.joined(first.cameras),
            times=torch.cat([static.times, torch.zeros_like(first.times)]),
            view=torch.arange(len(static) + len(first)),
            names=static.names + first.names,
            valid_mask=torch.cat(valid) if valid else None,
            frames=torch.cat([static.frames, first.frames]),
        )

    def capture(self, name: CaptureName) -> Capture:
        """The capture called ``static`` or ``dynamic``."""
        return self.static if name == "static" else self.dynamic

    def training_views(self, name: ImagesName) -> Views:
        """The training views of a capture, or those :attr:`at_rest`."""
        return self.at_rest if name == "at_rest" else self.capture(name).train

    @property
    def captures(self) -> dict[CaptureName, Capture]:
        """The captures by name; the static one alone if the scene never moves."""
        static: dict[CaptureName, Capture] = {"static": self.static}
        return {**static, "dynamic": self.dynamic} if self.moves else static

    @property
    def clock(self) -> FrameClock:
        """The clock of the dynamic training views' times."""
        return FrameClock.from_times(self.dynamic.train.times)

    @property
    def moves(self) -> bool:
        """Whether the training images have more than one time."""
        return len(self.clock) > 1

    @property
    def fingerprint(self) -> str:
        """A short hash of cameras, times and image sizes, by which scenes are told apart."""
        digest = hashlib.sha256(self.kind.encode())
        if any(self.offset):
            digest.update(f"{self.offset}".encode())
        for capture in (self.static, self.dynamic):
            for views in (capture.train, capture.test):
                digest.update(f"{tuple(views.pixels.shape)}".encode())
                cameras = views.cameras
                parts = [cameras.camera_to_world, cameras.focal, views.times]
                for part in parts if cameras.sizes is None else [*parts, cameras.sizes]:
                    digest.update(part.float().cpu().numpy().tobytes())
        return digest.hexdigest()[:16]

    @property
    def look(self) -> tuple[float, ...]:
        """Mean colours of quarters of two held-out images, on black, in [0, 1]."""
        images = (self.static.test.pixels[:1], self.dynamic.test.pixels[-1:])
        channels_first = (on_background(pixels, 0.0).permute(0, 3, 1, 2) for pixels in images)
        return tuple(
            torch.cat([adaptive_avg_pool2d(c, 2).flatten() for c in channels_first]).tolist()
        )
