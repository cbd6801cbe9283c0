"""A cloud of Gaussians that is learned: where it begins, how it grows and is pruned."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize, one_hot, pad

from devrf.checkpoints.stored_grids import StoredShape
from devrf.engine.ddp import average, world_size
from devrf.geometry.box import Box
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WorldSpace
from devrf.methods.gaussians.settings import GaussiansSettings
from devrf.ops.spherical_harmonics import FACTORS
from devrf.ops.splatting import Gaussians, rotations
from devrf.scenes.scene import Scene, Views
from devrf.scenes.silhouettes import visual_hull

# What is added to, and multiplied by the first harmonic, is a colour.
GREY = 0.5
# Opacities are at most this after a reset.
RESET = 0.01
# Factors of scales of the two that one is split into: of all, and of the longest of halves.
SPLIT = 1 / 1.6
HALVED = 1 / 1.8
# How far from the middle the halves lie, in standard deviations.
APART = 0.6
# Of an unbounded scene's box, on whose faces infinity is, so much holds the first points.
NOT_FAR = 0.9
# OpenCV's name of a k-d tree that is searched whole.
KD_TREE = 4
# Of coordinates whose squares a float holds.
FARTHEST = 1e18
# Nearest Gaussians whose embeddings are held alike.
NEIGHBOURS = 6


class Cloud(StoredShape):
    """N Gaussians as they are learned.

    Attributes:
        means: (N, 3) world units.
        scales: (N, 3) logarithms.
        quaternions: (N, 4) w first.
        opacity: (N,) logits.
        color: (N, 3) factors of the harmonic of degree 0.
        harmonics: (N, K, 3) factors of the others.
        embedding: (N, E) what the deformation network is told of each beside its place.
        neighbours: (N, 6) the nearest to each at the last growth, by row; (N, 0) if E is 0.
        seen: (N, 2) sums since the last growth: the length of ∂L/∂centre, and times it was seen.
        grown: () int64, the number of growths.
    """

    at_rest: ClassVar = ("means", "scales", "quaternions", "opacity", "color", "harmonics")
    parts: ClassVar = (*at_rest, "embedding")
    resizable = dict.fromkeys((*parts, "neighbours", "seen"), 1)
    means: nn.Parameter
    scales: nn.Parameter
    quaternions: nn.Parameter
    opacity: nn.Parameter
    color: nn.Parameter
    harmonics: nn.Parameter
    embedding: nn.Parameter
    neighbours: Tensor
    seen: Tensor
    grown: Tensor

    def __init__(self, degree: int, embedding: int = 0) -> None:
        super().__init__()
        self.degree, self.embedding_size = degree, embedding
        nearest = torch.zeros(1, NEIGHBOURS if embedding else 0, dtype=torch.int64)
        self.register_buffer("neighbours", nearest)
        self.register_buffer("grown", torch.zeros((), dtype=torch.int64))
        self.register_buffer("seen", torch.zeros(1, 2))
        self.begin(torch.zeros(1, 3), torch.full((1, 3), GREY), torch.ones(1), 0.5)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        if {len(getattr(self, name)) for name in self.resizable} != {len(self)}:
            raise ValueError("parts of other numbers of Gaussians")
        if not ((self.neighbours >= 0) & (self.neighbours < len(self))).all():
            raise ValueError("neighbours that are no Gaussians")

    def __len__(self) -> int:
        return len(self.means)

    def begin(self, points: Tensor, colors: Tensor, sizes: Tensor, opacity: float) -> None:
        """Round Gaussians at points (N, 3), of colours (N, 3) and sizes (N,)."""
        count = len(points)
        others = (self.degree + 1) ** 2 - 1
        values = {
            "means": points,
            "scales": sizes.log()[:, None].repeat(1, 3),
            "quaternions": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
            "opacity": torch.full((count,), math.log(opacity / (1 - opacity))),
            "color": (colors - GREY) / FACTORS[0],
            "harmonics": torch.zeros(count, others, 3),
            "embedding": torch.zeros(count, self.embedding_size),
        }
        self._take({name: value.to(self.seen.device) for name, value in values.items()})
        self._find_neighbours()

    def _take(self, values: dict[str, Tensor]) -> None:
        for name, value in values.items():
            learns = getattr(self, name).requires_grad if hasattr(self, name) else True
            setattr(self, name, nn.Parameter(value, requires_grad=learns))
        self.seen = self.seen.new_zeros(len(self.means), 2)
        self.neighbours = self.neighbours.new_zeros(len(self.means), self.neighbours.shape[1])

    @torch.no_grad()
    def _find_neighbours(self) -> None:
        if self.embedding_size and len(self) > 1:
            found = nearest(self.means, NEIGHBOURS)[1]
            again = torch.arange(NEIGHBOURS, device=found.device) % found.shape[1]
            self.neighbours = found[:, again]

    @torch.no_grad()
    def keep(self, rows: Tensor) -> None:
        """Remove the Gaussians where the mask ``rows`` (N,) is False."""
        self._take({name: getattr(self, name)[rows] for name in self.parts})

    def gaussians(self, moves: tuple[Tensor, Tensor, Tensor] | None, basis: Tensor) -> Gaussians:
        """The Gaussians with ``moves`` (N, 3), (N, 4), (N, 3) of means, rotations and scales.

        ``basis`` (N, K) are the harmonics of the directions to them.
        """
        parts: tuple[Tensor, Tensor, Tensor] = (
            self.means,
            normalize(self.quaternions, dim=1),
            self.scales,
        )
        if moves is not None:
            parts = (parts[0] + moves[0], parts[1] + moves[1], parts[2] + moves[2])
        means, quaternions, scales = parts
        color: Tensor = GREY + FACTORS[0] * self.color
        if basis.shape[1] > 1:
            used = self.harmonics[:, : basis.shape[1] - 1]
            color = color + (basis[:, 1:, None] * used).sum(dim=1)
        opacity, color = self.opacity.sigmoid(), color.clamp(min=0)
        return Gaussians(means, scales.exp(), quaternions, opacity, color)

    def note(self, slopes: Tensor) -> None:
        """Count slopes of the centres (N, 2), per half of the image, of those that were seen."""
        length = slopes.norm(dim=1)
        shown = (length > 0) & length.isfinite()
        seen = torch.stack([length.where(shown, 0.0), shown.to(length)], dim=1)
        processes = world_size()  # which go on from one file: all count what each has seen
        self.seen += seen if processes == 1 else processes * average(seen)

    @torch.no_grad()
    def grow(self, settings: GaussiansSettings, extent: float, *, reset: bool) -> dict[str, Tensor]:
        """Prune, clone and split, and ``reset`` opacities if that is due.

        Returns:
            by the name of each part, the row (M,) of the cloud before that each one was; −1: new.
        """
        # Of both halves of what was split, and the same in all processes.
        rng = torch.Generator().manual_seed(int(self.grown))
        self.grown += 1
        size = self.scales.exp().amax(dim=1)
        keep = self.opacity.sigmoid() >= settings.prune_below
        if settings.reset_every and self.grown * settings.densify_every > settings.reset_every:
            keep &= size <= settings.prune_above * extent
        keep |= ~keep.any()
        want = torch.where(keep, self.seen[:, 0] / self.seen[:, 1].clamp(min=1), -1.0)
        room = min(
            round(settings.densify_share * len(self)),
            settings.max_points - int(keep.sum()),
            int((want > settings.densify_above).sum()),
        )
        chosen = want.topk(max(room, 0)).indices
        kept = keep.nonzero()[:, 0]
        rows = torch.cat([kept, chosen])
        new = torch.arange(len(rows), device=rows.device) >= len(kept)
        split = torch.zeros_like(keep)
        split[chosen] = size[chosen] > settings.split_above * extent
        split = split[rows]
        values = {name: getattr(self, name).detach()[rows] for name in self.parts}
        if settings.split == "halved":
            longest = one_hot(values["scales"].argmax(dim=1), 3).to(values["means"])
            place = APART * torch.where(new, 1.0, -1.0)[:, None] * longest
            shrink = math.log(HALVED) * longest
            source = torch.where(new, -1, rows)
        else:
            place = torch.randn(len(rows), 3, generator=rng).to(values["means"])
            shrink = torch.full_like(place, math.log(SPLIT))
            source = torch.where(new | split, -1, rows)
        offset = values["scales"].exp() * place
        turned = (rotations(values["quaternions"]) @ offset[:, :, None])[:, :, 0]
        values["means"] = values["means"] + torch.where(split[:, None], turned, 0.0)
        values["scales"] = values["scales"] + torch.where(split[:, None], shrink, 0.0)
        sources = dict.fromkeys(self.parts, source)
        if reset:
            values["opacity"] = values["opacity"].clamp(max=math.log(RESET / (1 - RESET)))
            sources["opacity"] = torch.full_like(source, -1)
        self._take(values)
        self._find_neighbours()
        return sources


def first_points(scene: Scene, settings: GaussiansSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Points (N, 3) where the cloud begins, their colours (N, 3) and sizes (N,)."""
    views, box = scene.at_rest, scene.bounds.box
    side = settings.hull_side
    points = torch.empty(0, 3)
    if side > 1 and views.cut_out and not isinstance(scene.space, NormalizedDevice):
        points = hull_surface(views, box, side)
    if len(points) == 0:
        world = isinstance(scene.space, WorldSpace)
        low, high = scene.bounds.whole.scaled(1.0 if world else NOT_FAR).corners(points)
        points = low + torch.rand(settings.start_points, 3) * (high - low)
        points = scene.space.to_world(points)
    points = points[torch.randperm(len(points))[: settings.start_points]]
    sizes = settings.start_size * neighbour_distances(points)
    return points, median_colors(points, views), sizes


def hull_surface(views: Views, box: Box, side: int) -> Tensor:
    """Points (N, 3) of a grid over the box on the surface of the visual hull, a little moved."""
    shape = box.grid_shape(side**3)
    hull = visual_hull(views, box, shape, whole_in_view=True)
    outside = pad(~hull, (1,) * 6, value=True)
    near = torch.zeros_like(outside)
    for axis in range(3):
        near |= outside.roll(1, axis) | outside.roll(-1, axis)
    points = box.grid_points(shape, views.cameras.focal)[hull & near[1:-1, 1:-1, 1:-1]]
    return points + 0.25 * box.longest / (side - 1) * torch.randn(len(points), 3)


def median_colors(points: Tensor, views: Views) -> Tensor:
    """RGB (N, 3): the median colour of the opaque pixels on which each point falls."""
    seen: list[Tensor] = []
    for k in range(len(views)):
        pixel, depth = views.cameras.project_into(k, points)
        x, y = pixel.floor().long().unbind(1)
        width, height = views.cameras.size_of(k)
        inside = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        pixels = views.pixels[k, y.clamp(0, height - 1), x.clamp(0, width - 1)].float() / 255
        if views.has_alpha:
            inside &= pixels[:, 3] > 0.5
        seen.append(torch.where(inside[:, None], pixels[:, :3], torch.nan))
    return torch.stack(seen).nanmedian(dim=0).values.nan_to_num(GREY)


def neighbour_distances(points: Tensor) -> Tensor:
    """The mean distance (N,) of each point from its three nearest ones; 1 of a single point."""
    if len(points) == 1:
        return points.new_ones(1)
    return nearest(points, 3)[0].mean(dim=1).clamp(min=1e-6)


def nearest(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The points nearest to each of (N, 3): their distances and their rows, each (N, K).

    K is ``count``, or less if there are fewer others.
    """
    count = min(count, len(points) - 1)
    # Numbers whose squares are some, so that there is a row for each.
    table = points.detach().nan_to_num().clamp(-FARTHEST, FARTHEST).cpu().numpy()
    tree = cv2.flann_Index(table, {"algorithm": KD_TREE})  # type: ignore[attr-defined]
    rows, squares = tree.knnSearch(table, count + 1, params={})
    own = rows == np.arange(len(table))[:, None]
    own[~own.any(axis=1), -1] = True  # of many points in one place
    chosen = [found[~own].reshape(-1, count) for found in (squares, rows)]
    distances, neighbours = (torch.from_numpy(found).to(points.device) for found in chosen)
    return distances.sqrt(), neighbours.long()
