"""Sizes of the canonical field (docs/method.md#canonical-field), adapted to a scene."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Annotated, ClassVar

import torch
from annotated_types import Ge, Gt, Le, Lt
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import Space
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.color_decoder import ColorDecoder, SigmoidColor
from devrf.scenes.scene import Scene
from devrf.system.options import Count, Options, Positive, Several

log = logging.getLogger(__name__)

# Parallax of a plane against the next, between the outermost static views: with less, the views
# hardly tell two planes apart, while fog before the scene takes long to clear.
PIXELS_PER_PLANE = 4.0
FEWEST, MOST = 32, 256
# Voxels to a pixel across from which on a field learns training views by heart, and no others.
LEARNED_BY_HEART = 2.0

# The opacity that a shorter search begins with, at most.
MOST_OPAQUE = 1e-2
# Of a voxel before anything is learned: nothing that a logarithm ends at.
Opacity = Annotated[float, Gt(0), Lt(1)]


@dataclass(frozen=True)
class Architecture(Options):
    """Sizes of the canonical field; the defaults are the paper's, inward-facing.

    Attributes:
        channels: features per voxel.
        width: units of each of the colour decoder's two hidden layers.
        frequencies: octaves of the viewing direction for the decoder; 0: the direction alone.
        alpha_init: opacity of a voxel of the radiance field before anything is learned.
        contracted_opacity: of a line through the box; decides ``alpha_init`` in contracted space.
        search_alpha_init: opacity of a voxel in the coarse geometry search.
        planes: planes of an NDC grid, one behind another; None: in NDC as many as the scene's
            views tell apart (:func:`fitted_to`), elsewhere cubic voxels.
        aspect: in NDC, grid points across a unit of x to those across a unit of y.
    """

    key: ClassVar[str] = "field"

    channels: Annotated[int, Ge(1), Le(256)] = 12
    width: Count = 128
    frequencies: Annotated[int, Ge(0), Le(16)] = 4
    alpha_init: Opacity = 1e-2
    contracted_opacity: Opacity = 0.65
    search_alpha_init: Opacity = 1e-6
    planes: Several | None = None
    aspect: Positive = 1.0

    def in_space(self, space: Space, side: float) -> Architecture:
        """The sizes that hold in ``space`` for a grid of ``side`` voxels along an edge."""
        if space.is_linear:
            return self
        return replace(self, alpha_init=1 - (1 - self.contracted_opacity) ** (1 / side))

    def for_search(self, factor: float) -> Architecture:
        """The architecture for a search of ``factor`` times the iterations.

        A shorter one begins less faintly. How long a search takes to see anything goes with the
        reciprocal of the opacity that it begins with: gradients are as faint, and far below Adam's
        epsilon.
        """
        faint = self.search_alpha_init
        opacity = min(faint / min(factor, 1.0), MOST_OPAQUE)
        return replace(self, search_alpha_init=max(faint, opacity))

    def search_field(self, box: Box, voxels: int) -> CanonicalField:
        """The field of the coarse geometry search: colours straight from three channels."""
        return CanonicalField(
            box, SigmoidColor(), channels=3, voxels=voxels, alpha_init=self.search_alpha_init
        )

    def radiance_field(self, box: Box, voxels: int, base_voxels: int) -> CanonicalField:
        """The radiance field: features and a shallow decoder."""
        return CanonicalField(
            box,
            ColorDecoder(self.channels, self.width, self.frequencies),
            channels=self.channels,
            voxels=voxels,
            base_voxels=base_voxels,
            alpha_init=self.alpha_init,
            planes=self.planes,
            aspect=self.aspect,
        )


def fitted_to(
    scene: Scene, schedule: CanonicalSchedule, architecture: Architecture
) -> tuple[CanonicalSchedule, Architecture]:
    """Schedule and architecture with the numbers that ``scene`` decides filled in.

    In NDC these are the planes that the static views resolve, and ``voxels_per_pixel`` as ``side``
    (docs/method.md#forward-facing); in contracted space see docs/method.md#scene-contraction.

    Raises:
        DevrfError: the architecture has planes, and the scene is not in NDC.
    """
    space, planes = scene.space, architecture.planes
    if not isinstance(space, NormalizedDevice):
        if planes is not None:
            raise DevrfError(
                f"field.planes={planes}: planes are of forward-facing scenes, and this scene is "
                "not: give facing=inward, or field.planes=null"
            )
        schedule = schedule.in_space(space)
        return schedule, architecture.in_space(space, schedule.side)
    if planes is None:
        planes = resolved_planes(scene.static.train.cameras.positions, space)
        architecture = replace(architecture, planes=planes)
    if schedule.voxels_per_pixel is not None:
        width, height, _ = scene.bounds.box.size
        # The reference image spans 2 × 2 units of NDC.
        across = width / 2 * space.width * schedule.voxels_per_pixel
        down = height / 2 * space.height * schedule.voxels_per_pixel
        schedule = replace(schedule, side=(across * down * planes) ** (1 / 3))
        architecture = replace(architecture, aspect=space.width / space.height)
    return schedule, architecture


def resolved_voxels(scene: Scene, schedule: CanonicalSchedule, box: Box) -> int:
    """Voxels of the finished grid over ``box``: by ``side``, or by the static views' resolution.

    See docs/method.md#resolution.
    """
    whole: int = round(schedule.side**3)
    finer = schedule.voxels_per_pixel
    # Around a hand-held camera's sparse points space is contracted; the images resolve no more
    # at their depth.
    fits = scene.space.is_linear or scene.dynamic.train.by_moving_camera
    if not fits or isinstance(scene.space, NormalizedDevice):
        return whole
    pixel = scene.static.train.cameras.pixel_size(torch.tensor(box.middle))
    if finer is None:
        across = pixel * (whole / box.volume) ** (1 / 3)
        if across > LEARNED_BY_HEART:
            log.warning(
                "schedule.canonical.side: %.4g voxels an edge are %.2g to a pixel, so fine that "
                "each learns single rays: give larger images, or "
                "schedule.canonical.voxels_per_pixel=1.3",
                schedule.side,
                across,
            )
        return whole
    edge = pixel / finer
    least = 8 << len(schedule.upsample_at)  # as few as its first phase may have
    resolved = min(whole, max(int(box.volume / edge**3), least))
    if resolved < whole:
        side, given = resolved ** (1 / 3), schedule.side
        log.info("schedule.canonical.side: %.4g of %g is what the images resolve", side, given)
    return resolved


def resolved_planes(positions: Tensor, space: NormalizedDevice) -> int:
    """Planes that cameras at ``positions`` (N, 3) tell apart (docs/method.md#forward-facing)."""
    apart = torch.cdist(positions[:, :2], positions[:, :2]).max()
    parallax = max(space.focal) * float(apart) / space.near
    return min(max(round(parallax / PIXELS_PER_PLANE) + 1, FEWEST), MOST)
