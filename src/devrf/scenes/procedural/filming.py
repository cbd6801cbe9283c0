"""Views of a moving shape: static and dynamic posed images, with exact depth and flow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.motion import moving, radius
from devrf.scenes.procedural.march import CHUNK, MAX_STEPS, STEPS_TO_WALLS, block_starts, trace
from devrf.scenes.procedural.solids import Body, Shape
from devrf.scenes.scene import Capture, OpticalFlow, Views

# Towards the lamp, world space: fixed, so that shading changes as the shape turns.
_LAMP = (0.40, -0.55, 0.73)
# Half the span over which a normal is measured, world units: well above float32 rounding.
_NORMAL_STEP = 1e-3


def shaded(shape: Shape, points: Tensor, time: float, light: float) -> Tensor:
    """Colour (M, 3) of surface ``points`` (M, 3): albedo, ambient light, a wrapped diffuse lamp.

    ``light`` is the share of the lamp in the lighting, 0 (albedo alone) … 1.
    """
    albedo = shape.color(shape.material(points, time))
    if light == 0:
        return albedo
    lamp = torch.nn.functional.normalize(points.new_tensor(_LAMP), dim=0)
    # Wrapped: the side away from the lamp still varies, and no edge of shadow is drawn.
    lit = 0.5 + 0.5 * (_normals(shape, points, time) @ lamp)
    return albedo * (1 - light + light * lit)[:, None]


def _normals(shape: Shape, points: Tensor, time: float) -> Tensor:
    """Unit normals (M, 3): the distance's gradient from its values at a tetrahedron's corners."""
    corners = points.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    around = (points + _NORMAL_STEP * corners[:, None]).reshape(-1, 3)
    values = shape.distance(around, time).view(4, -1)
    return torch.nn.functional.normalize(values.T @ corners, dim=-1)


# Motion is sampled at this many times; the margin covers the motion between them.
_TIMES = 97
_MARGIN = 0.04


@dataclass(frozen=True)
class Extent:
    """The extent of a shape.

    Attributes:
        canonical: a cube about the origin that holds the canonical shape.
        motion: the box of the shape at all times in [0, 1].
        reach: radius of a ball about the origin that holds it at all times, world units.
    """

    canonical: Box
    motion: Box
    reach: float


def extent(shape: Body) -> Extent:
    """The extent of ``shape``, from the paths of the points around its parts."""
    outline = shape.outline()
    times = torch.linspace(0, 1, _TIMES).tolist()
    paths = torch.stack([shape.forward(outline, time) for time in times])
    half = float(outline.canonical.abs().max()) + _MARGIN
    points = paths.reshape(-1, 3)
    return Extent(
        canonical=Box.of([-half] * 3, [half] * 3),
        motion=Box.of(points.amin(dim=0) - _MARGIN, points.amax(dim=0) + _MARGIN),
        reach=float(points.norm(dim=-1).max()) + _MARGIN,
    )


def moved(shape: Shape, points: Tensor, time: float, to: float) -> Tensor:
    """Positions (M, 3), at time ``to``, of the material of surface ``points`` at ``time``."""
    return shape.forward(shape.material(points, time), to)


def exact_flow(shape: Shape, views: Views, *, forward: bool = False) -> OpticalFlow:
    """Exact backward (or forward) flow of ``views`` with depth, the same cameras at each frame.

    They may have moved between frames. The point that the ray through a pixel's centre meets is
    carried to the frame before (after) and projected into its camera there; it may be hidden there,
    or outside of the image. Flow is 0 and not valid for rays that meet nothing, and in the first
    (last) frame.
    """
    assert views.depth is not None
    times = torch.unique(views.times).tolist()
    pairs = zip(times, times[1:], strict=False) if forward else zip(times[1:], times, strict=False)
    vectors = views.depth.new_zeros(*views.depth.shape, 2)
    valid = torch.zeros_like(views.depth, dtype=torch.bool)
    for time, other in pairs:
        images, others = ((views.times == moment).nonzero()[:, 0] for moment in (time, other))
        for image, seen_from in zip(images.tolist(), others.tolist(), strict=True):
            met, points = _met(views, image)
            there, _ = views.cameras.project_into(seen_from, moved(shape, points, time, other))
            vectors[image].view(-1, 2)[met] = there - views.cameras.pixel_grid()[met]
            valid[image].view(-1)[met] = True
    return OpticalFlow(vectors, valid)


# A point is seen well if so many images show it, or a tenth of all if these are more (DyCheck);
# half of all suffice if there are few.
_SEEN_BY = 5
# The number of key points.
_KEYPOINTS = 32
# A point is visible in an image if it is at most so much farther away, as a share.
_SAME_DEPTH = 0.02


def covisible(shape: Shape, views: Views, learned: Views) -> Tensor:
    """Mask (N, H, W) of the pixels of ``views`` whose points enough images of ``learned`` show.

    The point that the ray through a pixel's centre meets is carried to the time of each training
    image, and projected into it. Points that training hardly saw are not scored (Gao et al.,
    *Monocular Dynamic View Synthesis: A Reality Check*, 2022).
    """
    assert views.depth is not None and learned.depth is not None
    needed = min(max(_SEEN_BY, len(learned) // 10), math.ceil(len(learned) / 2))
    masks = torch.zeros_like(views.depth, dtype=torch.bool)
    for k, time in enumerate(views.times.tolist()):
        met, points = _met(views, k)
        material = shape.material(points, time)
        count = torch.zeros(len(points), dtype=torch.long)
        for image, other in enumerate(learned.times.tolist()):
            count += _shown(learned, image, shape.forward(material, other))[1]
        masks[k].view(-1)[met] = count >= needed
    return masks


def _met(views: Views, image: int) -> tuple[Tensor, Tensor]:
    """Positions (M,) of the pixels whose rays meet a surface, and the points (M, 3) there."""
    assert views.depth is not None
    depth = views.depth[image].flatten()
    met = depth.isfinite().nonzero()[:, 0]
    return met, views.cameras.image_rays(image).at(met, depth[met])


def _shown(views: Views, image: int, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (M, 2) of points (M, 3) at an image's time, and whether the image shows each (M,)."""
    assert views.depth is not None
    size = torch.tensor([views.width, views.height])
    pixels, ahead = views.cameras.project_into(image, points)
    inside = (ahead > 0) & ((pixels >= 0) & (pixels < size)).all(dim=-1)
    column, row = pixels.clamp(min=torch.zeros(2), max=size - 1).long().unbind(-1)
    depth = views.depth[image][row, column]
    away = (points - views.cameras.positions[image]).norm(dim=-1)
    return pixels, inside & (away <= (1 + _SAME_DEPTH) * depth)


def with_motion(shape: Shape, capture: Capture) -> Capture:
    """The capture with exact masks of what moves in its held-out images, and with key points.

    The point that the ray through a pixel's centre meets moves, or does not, over all times of the
    held-out images. Key points are the moving ones among those that the first training image shows.
    """
    train, test = capture.train, capture.test
    times = sorted({0.0, *test.times.tolist()})
    rest = [_met(v, k)[1] for v in (train, test) for k in (v.times == 0).nonzero()[:, 0].tolist()]
    size = radius(torch.cat(rest))

    def moves(points: Tensor, time: float) -> Tensor:
        material = shape.material(points, time)
        return moving((shape.forward(material, other) for other in times), size)

    masks = torch.zeros_like(test.pixels[..., 0], dtype=torch.bool)
    for k, time in enumerate(test.times.tolist()):
        met, points = _met(test, k)
        masks[k].view(-1)[met] = moves(points, time)
    capture = replace(capture, test=replace(test, motion_mask=masks))
    first = rest[0][moves(rest[0], 0.0)]
    if len(first) == 0:
        return capture
    material = shape.material(first[torch.linspace(0, len(first) - 1, _KEYPOINTS).long()], 0.0)
    sides = torch.tensor([train.width, train.height])
    keypoints = []
    for k, time in enumerate(train.times.tolist()):
        pixels, seen = _shown(train, k, shape.forward(material, time))
        keypoints.append(torch.cat([pixels / sides, seen[:, None]], dim=1))
    return replace(capture, keypoints=torch.stack(keypoints))


@dataclass(frozen=True)
class Filming:
    """A shape and the settings of its views.

    Attributes:
        shape: the shape; all cameras are outside of it.
        reach: radius of a ball about the origin that holds the shape at all times, world units.
        supersample: n: colour and alpha are the mean of n × n rays a pixel.
        light: share of the lamp in the lighting, 0 (albedo alone) … 1.
        opaque: whether every ray meets a surface, so that the images need no alpha.
    """

    shape: Shape
    reach: float
    supersample: int = 2
    light: float = 0.2
    opaque: bool = False

    def static(self, train: Cameras, test: Cameras) -> Capture:
        """One image from each camera at time 0."""
        pixels, depth = self.pictures(train.joined(test), 0.0)
        count = len(train)
        return Capture(
            train=_each(train, pixels[:count], depth[:count], torch.zeros(count), "static train"),
            test=_each(test, pixels[count:], depth[count:], torch.zeros(len(test)), "static test"),
        )

    def dynamic(
        self, train: Cameras, test: Cameras, frames: int, unseen: Sequence[int] = ()
    ) -> Capture:
        """All fixed cameras at frame 0, then all at frame 1, …, with the exact backward flow.

        There are ``frames`` ≥ 2 frames, at times k / (T − 1); the training cameras leave out those
        in ``unseen``.
        """
        everyone = train.joined(test)
        times = torch.arange(frames) / (frames - 1)
        pixels, depth = self._shot([everyone] * frames, times)
        learned = [frame for frame in range(frames) if frame not in unseen]
        count = len(train)
        views = _moving(
            train, pixels[learned, :count], depth[learned, :count], times, learned, "train"
        )
        others = _moving(test, pixels[:, count:], depth[:, count:], times, range(frames), "test")
        capture = Capture(
            train=replace(views, flow=exact_flow(self.shape, views)),
            test=replace(others, flow=exact_flow(self.shape, others)),
        )
        return with_motion(self.shape, capture)

    def handheld(self, camera: Cameras, others: Cameras) -> Capture:
        """The video of one moving camera, with the exact backward flow, and held-out views.

        ``camera`` has its pose at each of T ≥ 2 frames, at times k / (T − 1); ``others`` has
        another view at each of them, of which only :func:`covisible` pixels are scored.
        """
        times = torch.arange(len(camera)) / (len(camera) - 1)
        pairs = [camera[[k]].joined(others[[k]]) for k in range(len(camera))]
        pixels, depth = self._shot(pairs, times)
        train = _each(camera, pixels[:, 0], depth[:, 0], times, "hand-held train frame")
        test = _each(others, pixels[:, 1], depth[:, 1], times, "hand-held test frame")
        capture = Capture(
            train=replace(train, flow=exact_flow(self.shape, train)),
            test=replace(test, valid_mask=covisible(self.shape, test, train)),
        )
        return with_motion(self.shape, capture)

    def _shot(self, cameras: Sequence[Cameras], times: Tensor) -> tuple[Tensor, Tensor]:
        """Pictures (T, N, H, W, ·), distances (T, N, H, W) from N cameras at each of T times."""
        moments = zip(cameras, times.tolist(), strict=True)
        pixels, depths = zip(*(self.pictures(some, time) for some, time in moments), strict=True)
        return torch.stack(pixels), torch.stack(depths)

    def pictures(self, cameras: Cameras, time: float) -> tuple[Tensor, Tensor]:
        """One image from each of N ``cameras`` at ``time``.

        Returns:
            (N, H, W, 4) uint8 RGBA, alpha not premultiplied, or (N, H, W, 3) where opaque; and
            (N, H, W) float32 distances along the rays through the pixels' centres, world units,
            +inf where these meet nothing.
        """
        start = block_starts(self.shape, cameras, time, self.reach)
        size = start.shape
        start = start.reshape(-1)
        depth = torch.full_like(start, torch.inf)
        image = start.new_zeros(len(start), 4)
        grid = cameras.pixel_grid()
        # A pixel's centre, for its depth, and the centres of its n × n parts, for its colour.
        steps = (torch.arange(self.supersample) + 0.5) / self.supersample - 0.5
        offsets = torch.cat([torch.zeros(1, 2), torch.cartesian_prod(steps, steps)])
        count = len(offsets)
        most = STEPS_TO_WALLS if self.opaque else MAX_STEPS
        live = start.isfinite().nonzero().squeeze(-1)
        for pixel in torch.split(live, max(CHUNK // count, 1)):
            centers = grid[pixel % len(grid)]
            rays = cameras.rays(
                (pixel // len(grid)).repeat(count), (centers + offsets[:, None]).view(-1, 2)
            )
            onset = start[pixel].repeat(count)
            distance = trace(self.shape, rays, time, onset, self.reach, most)
            depth[pixel] = distance[: len(pixel)]
            hit = distance[len(pixel) :].isfinite().nonzero().squeeze(-1) + len(pixel)
            # Colour times alpha, and alpha: only these may be averaged.
            samples = start.new_zeros(len(rays), 4)
            samples[hit, 3] = 1
            samples[hit, :3] = shaded(self.shape, rays.at(hit, distance[hit]), time, self.light)
            mean = samples.view(count, -1, 4)[1:].mean(dim=0)
            color = mean[:, :3] / mean[:, 3:].clamp_min(1e-6)
            image[pixel] = torch.cat([color, mean[:, 3:]], dim=-1)
        pixels = (image * 255).round().clamp(0, 255).to(torch.uint8).view(*size, 4)
        if self.opaque:
            pixels = pixels[..., :3].contiguous()
        return pixels, depth.view(size)


def _each(cameras: Cameras, pixels: Tensor, depth: Tensor, times: Tensor, label: str) -> Views:
    """One image from each camera."""
    order = torch.arange(len(cameras))
    names = tuple(f"{label} {k:03d}" for k in order.tolist())
    return Views(pixels, cameras, times, order, names, depth=depth)


def _moving(
    cameras: Cameras,
    pixels: Tensor,
    depth: Tensor,
    times: Tensor,
    frames: Sequence[int],
    split: str,
) -> Views:
    view = torch.arange(len(cameras)).repeat(len(frames))
    names = (
        f"dynamic {split} frame {frame:03d} view {v}"
        for frame in frames
        for v in range(len(cameras))
    )
    return Views(
        pixels.flatten(0, 1),
        cameras[view],
        times[list(frames)].repeat_interleave(len(cameras)),
        view,
        tuple(names),
        depth=depth.flatten(0, 1),
    )
