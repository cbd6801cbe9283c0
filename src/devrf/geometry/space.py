"""The space that fields live in: the world itself, or an unbounded part of it made into a box."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Protocol

from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.rays import Rays
from devrf.system.plain_data import validate


class Space(Protocol):
    """A mapping between world space and the space of the fields.

    :class:`WorldSpace` for inward-facing scenes,
    :class:`~devrf.geometry.ndc.NormalizedDevice` for forward-facing ones,
    :class:`~devrf.geometry.contraction.ContractedSpace` for scenes unbounded on every side.
    """

    @property
    def is_linear(self) -> bool:
        """Whether world rays are straight lines in it, walked evenly."""
        ...

    @property
    def side_factor(self) -> float:
        """Length of a grid's side here, as a multiple of the configured one."""
        ...

    def inner(self, box: Box) -> Box:
        """The part of the fields' ``box`` that the cameras look at, where things may move."""
        ...

    def from_world(self, points: Tensor) -> Tensor:
        """Points (..., 3) of the world in the fields' space."""
        ...

    def to_world(self, points: Tensor) -> Tensor:
        """Points (..., 3) of the fields' space in the world."""
        ...

    def rays(self, rays: Rays) -> Rays:
        """World rays in the fields' space; their view directions stay those of the world."""
        ...

    def depths(self, rays: Rays, distance: Tensor) -> Tensor:
        """Distances (M,) along :meth:`rays` of points so far (M,) along M world rays."""
        ...

    def depth_range(
        self, box: Box, limits: tuple[float, float], position: Tensor
    ) -> tuple[float, float]:
        """Depths between which a scene in ``box`` lies, about, for pictures of depth.

        Args:
            box: the scene's, in this space.
            limits: the distances between which rays are sampled, in this space.
            position: (3,) the camera's, in world units.
        """
        ...


@dataclass(frozen=True)
class WorldSpace:
    """Fields that live in world space: nothing is mapped."""

    is_linear: ClassVar[bool] = True
    side_factor: ClassVar[float] = 1.0

    def inner(self, box: Box) -> Box:
        """All of the box."""
        return box

    def from_world(self, points: Tensor) -> Tensor:
        """The points themselves."""
        return points

    def to_world(self, points: Tensor) -> Tensor:
        """The points themselves."""
        return points

    def rays(self, rays: Rays) -> Rays:
        """The rays themselves."""
        return rays

    def depths(self, rays: Rays, distance: Tensor) -> Tensor:
        """The distances themselves."""
        return distance

    def depth_range(
        self, box: Box, limits: tuple[float, float], position: Tensor
    ) -> tuple[float, float]:
        """The middle of the box, and a third of its diagonal before and behind it."""
        distance = math.dist(position.tolist(), box.middle)
        reach = math.dist(box.low, box.high) / 3
        return max(distance - reach, 0.0), distance + reach


WORLD = WorldSpace()
# By their names in checkpoints.
KINDS: dict[str, type[NormalizedDevice] | type[ContractedSpace]] = {
    "ndc": NormalizedDevice,
    "contracted": ContractedSpace,
}


def space_config(space: Space) -> dict[str, Any]:
    """A space as plain data with its ``kind``; the world is empty."""
    for kind, space_type in KINDS.items():
        if isinstance(space, space_type):
            return {"kind": kind, **asdict(space)}
    return {}


def space_from(config: Mapping[str, Any]) -> Space:
    """The space that :func:`space_config` described."""
    if not config:
        return WORLD
    values = dict(config)
    space: Space = validate(KINDS[values.pop("kind")], values)
    return space
