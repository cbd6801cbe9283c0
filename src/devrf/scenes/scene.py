"""What a scene is, whatever files it came from: frozen, typed, on the host, uint8."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.geometry.offset import NO_OFFSET, Offset
from devrf.geometry.space import WORLD, Space

Background = Literal["white", "black", "random"]
CaptureName = Literal["static", "dynamic"]
# What is learned from: the images of a capture, or all of the scene at rest (Scene.at_rest).
ImagesName = Literal["static", "dynamic", "at_rest"]


@dataclass(frozen=True)
class OpticalFlow:
    """Optical flow of N images: backward, where each pixel was one frame earlier in its own view.

    Forward flow is the same of one frame later.

    Attributes:
        vectors: (N, H, W, 2) float32, pixels, x then y: (pixel one frame earlier) − (this pixel).
        valid: (N, H, W) bool; False where the flow is unknown or not to be trusted, and on all
            of an image without an earlier frame.
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
        view: (N,) int64, which fixed camera took the image (0 … V−1); in a static set, or for a
            moving camera, the image's own number.
        names: N file names or labels, for messages and tables.
        flow: backward optical flow, or None where there is none.
        forward_flow: forward optical flow; None where there is none, or no method asked for it.
        depth: (N, H, W) float32 distance along each pixel's ray in world units, +inf where the
            ray hits nothing; None where it is unknown.
        ambiguous_orientation: (N,) bool, files whose EXIF orientation says that they are to be seen
            turned, which nothing confirms or refutes: they are as they are stored. None: none.
        valid_mask: (N, H, W) bool, the pixels that are learned from and scored; the others are
            ignored. None: all of them.
        exposure_mask: (N, H, W) bool, of held-out images that each have an exposure of their own:
            the pixels that tell it. None: they have that of the images learned from.
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

    @property
    def cut_out(self) -> bool:
        """Whether something is left out by the alpha masks: an opaque one says nothing."""
        return self.has_alpha and bool((self.pixels[..., 3] < 255).any())

    @property
    def by_moving_camera(self) -> bool:
        """Whether no two images are of one place: a camera moved between all of them."""
        return len(set(self.view.tolist())) == len(self)

    def __getitem__(self, index: Tensor) -> Views:
        """The views at positions ``index`` (K,) int64."""
        return replace(
            self.mapped(lambda of_views: of_views[index]),
            names=tuple(self.names[i] for i in index.tolist()),
        )

    def single(self, image: int) -> Views:
        """One of the images alone, its raster no larger than itself; nothing is copied.

        It has a ``valid_mask`` if some of its pixels are not valid, or that of images of one size.
        """
        place = slice(image, image + 1)
        view = replace(self.mapped(lambda of_views: of_views[place]), names=self.names[place])
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
    """One recording: images to learn from and images held out.

    Attributes:
        train: what the fields are learned from.
        test: held-out views, never seen in training.
        validation: held-out views by which settings are chosen, none of them in ``test``; None
            where they were not asked for, or there are none.
    """

    train: Views
    test: Views
    validation: Views | None = None

    def mapped(self, change: Callable[[Views], Views]) -> Capture:
        """The capture with ``change`` made to all of its views."""
        validation = None if self.validation is None else change(self.validation)
        return Capture(change(self.train), change(self.test), validation)


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
class Bounds:
    """Where the scene is, in the space that its fields live in (world units, or NDC).

    Attributes:
        box: holds everything that can be seen of the static scene (before it is tightened).
        near: distance from a camera under which nothing is.
        far: distance from a camera beyond which nothing is.
        motion: holds everything that moves at any time, or None where it is unknown and the
            canonical box is enlarged by ``scale`` instead.
        scale: how much larger than the tightened canonical box the fields' box is made, about
            its centre, so that motion has room; not used when ``motion`` is known.
        source: where the motion box came from, in words, for the log.
        limited: whether motion has no more room than the box: it was given, and nothing is known.
        box_given: whether the box was given by options or files, not found from the cameras.
        reason: why the scene is learned in its space, in words.
        box_source: where the box came from, in words.
    """

    box: Box
    near: float
    far: float
    motion: Box | None
    scale: float
    source: str
    limited: bool = False
    box_given: bool = False
    reason: str = ""
    box_source: str = ""

    @property
    def whole(self) -> Box:
        """Holds the static scene and everything that moves."""
        return self.box if self.motion is None else self.box.union(self.motion)


@dataclass(frozen=True)
class Scene:
    """A static → dynamic capture, or a static one alone.

    Attributes:
        name: short name for folders and tables.
        kind: ``inward`` (cameras around the scene) or ``forward`` (cameras before it, NDC).
        static: many views of the scene at rest (t = 0).
        dynamic: a few fixed views of the scene as it deforms; the static capture itself if the
            scene is always at rest. It alone has validation views.
        bounds: where the scene is.
        background: what is behind the alpha mask.
        space: the space that the fields live in, and in which ``bounds`` are given.
        offset: what was subtracted from all positions of the capture's world
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
    def is_film(self) -> bool:
        """Whether a camera that moves took all images: there is no static set.

        Images of the film stand in for it. Of two captures the fixed cameras' first images may
        belong to both.
        """
        film = self.dynamic.train
        shared = not {*self.static.train.names}.isdisjoint(film.names)
        return shared and film.by_moving_camera

    @property
    def at_rest(self) -> Views:
        """The static training views and the first frames of the dynamic ones, at time 0.

        The static ones alone, if the others are of another size or by a moving camera, or if only
        one of both sets has masks. An image from the place of a static one is left out.
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
        """The captures by name; the static one alone if the scene is at rest."""
        static: dict[CaptureName, Capture] = {"static": self.static}
        return {**static, "dynamic": self.dynamic} if self.moves else static

    @property
    def clock(self) -> FrameClock:
        """The clock of the dynamic training views' times."""
        return FrameClock.from_times(self.dynamic.train.times)

    @property
    def moves(self) -> bool:
        """Whether it was seen at more than one time."""
        return len(self.clock) > 1

    @property
    def fingerprint(self) -> str:
        """A short hash of cameras, times and image sizes: tells one scene from another."""
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
