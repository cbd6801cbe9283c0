"""Sizes and sampling of a radiance field behind a deformation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from devrf.errors import DevrfError
from devrf.methods.nerf.networks import Initialisation, RadianceField

Sampling = Literal["hierarchical", "occupancy"]


def check_empty_from(key: str, share: float | None) -> None:
    """Refuse what is no share of a stage.

    Raises:
        DevrfError: it is not in [0, 1].
    """
    if share is not None and not 0 <= share <= 1:
        raise DevrfError(f"{key}.empty_from: expected 0 to 1, or null, not {share}")


@dataclass(frozen=True)
class FieldSettings:
    """What D-NeRF, Nerfies and HyperNeRF have in common.

    Attributes:
        width: units of each layer of the radiance field.
        depth: layers of the radiance field.
        skip: the layer, counted from 0, that its input enters again; None: the middle one.
        bands: octaves of positions.
        direction_bands: octaves of viewing directions.
        density_scale: density of a softplus of 1, per half of the box's longest edge.
        initialisation: of all layers: ``uniform`` (PyTorch's) or ``glorot``.
        precision: what the radiance field computes in while it learns: float32, bfloat16, or
            ``auto`` (bfloat16 on a GPU that multiplies it). All else is in float32.
        sampling: ``hierarchical`` (coarse, then fine by weight) or ``occupancy`` (even steps where
            something may be).
        coarse: samples a ray before weights are known (hierarchical).
        fine: samples a ray that are drawn by weight (hierarchical).
        separate_coarse: whether coarse samples have a radiance field of their own, learned with the
            other one (hierarchical).
        steps: samples along the box's diagonal (occupancy).
        occupancy_side: the masks have about side³ cells (occupancy).
        hull: whether these are the visual hulls of each frame's masks, where there are any, which
            the published methods never had (occupancy).
        empty_from: where there are no such hulls, space that the fields leave empty at all times
            is left out after this share of a stage; None: never (occupancy).
    """

    key: ClassVar[str] = "ray_stage.model.settings"

    width: int = 256
    depth: int = 8
    skip: int | None = None
    bands: int = 10
    direction_bands: int = 4
    density_scale: float = 10.0
    initialisation: Initialisation = "uniform"
    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    sampling: Sampling = "hierarchical"
    coarse: int = 64
    fine: int = 128
    separate_coarse: bool = False
    steps: int = 128
    occupancy_side: int = 48
    hull: bool = True
    empty_from: float | None = 0.25

    def __post_init__(self) -> None:
        for name in ("width", "depth", "coarse", "fine", "steps", "occupancy_side"):
            if getattr(self, name) < 2:
                raise DevrfError(
                    f"{self.key}.{name}: expected at least 2, not {getattr(self, name)}"
                )
        check_empty_from(self.key, self.empty_from)
        if self.separate_coarse and self.sampling == "occupancy":
            raise DevrfError(
                f"{self.key}.separate_coarse: sampling=occupancy has no coarse samples; write false"
            )

    def radiance_field(self, ambient: int = 0) -> RadianceField:
        """A radiance field of these sizes; ``ambient`` numbers enter beside the position."""
        return RadianceField(
            self.width,
            self.depth,
            self.bands,
            self.direction_bands,
            self.density_scale,
            skip=self.skip,
            ambient=ambient,
            initialisation=self.initialisation,
        )
