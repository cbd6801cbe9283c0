"""Sizes and sampling of radiance fields that are networks."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Literal

from devrf.errors import expect

Initialisation = Literal["uniform", "glorot"]
Precision = Literal["auto", "float32", "bfloat16"]

# The most samples of a ray.
SAMPLES = 1024
# The most octaves of an encoding.
BANDS = 32


class CheckedSettings:
    """Settings of a method that refuse impossible values."""

    key: ClassVar[str] = "ray_stage.model.settings"

    def check(self, name: str, holds: bool, expected: str) -> None:
        """Refuse the setting ``name`` unless a condition ``holds``.

        Raises:
            DevrfError: it does not.
        """
        expect(holds, f"{self.key}.{name}", expected, getattr(self, name))

    def check_least(self, minimum: int, *names: str) -> None:
        """Refuse settings below ``minimum``; raises as :meth:`check`."""
        for name in names:
            self.check(name, getattr(self, name) >= minimum, f"at least {minimum}")

    def check_samples(self, *names: str) -> None:
        """Refuse numbers of a ray's samples below 2 or above the most; raises likewise."""
        for name in names:
            self.check(name, 2 <= getattr(self, name) <= SAMPLES, f"2 to {SAMPLES}")


@dataclass(frozen=True)
class OccupancySettings(CheckedSettings):
    """How empty space is skipped.

    Attributes:
        occupancy_side: the masks have about side³ cells.
        hull: whether the masks are the visual hulls of each frame's alpha masks, if there are any;
            the published methods never had these.
        empty_from: without such hulls, space that the fields leave empty at all times is left out
            after this share of a stage; None: never.
    """

    occupancy_side: int = 128
    hull: bool = True
    empty_from: float | None = 0.25

    def __post_init__(self) -> None:
        self.check_least(2, "occupancy_side")
        for name in (field.name for field in fields(self) if field.name.endswith("bands")):
            self.check(name, 0 <= getattr(self, name) <= BANDS, f"0 to {BANDS}")
        share = self.empty_from
        self.check("empty_from", share is None or 0 <= share <= 1, "0 to 1, or null")


@dataclass(frozen=True)
class PlacedSettings(OccupancySettings):
    """What D-NeRF, Nerfies, HyperNeRF and NSFF have in common.

    Attributes:
        width: units of each layer of a radiance field.
        depth: layers of a radiance field.
        skip: the layer, counted from 0, that its input enters again; None: the middle one.
        bands: octaves of positions.
        direction_bands: octaves of viewing directions.
        density_scale: density of a softplus of 1, per half of the box's longest edge.
        initialisation: of all layers: ``uniform`` (PyTorch's) or ``glorot``.
        precision: what a radiance field computes in while it learns: float32, bfloat16, or
            ``auto`` (bfloat16 on a GPU that multiplies it). All else is in float32.
        steps: samples along the box's diagonal (occupancy).
    """

    width: int = 256
    depth: int = 8
    skip: int | None = 5
    bands: int = 10
    direction_bands: int = 4
    density_scale: float = 10.0
    initialisation: Initialisation = "uniform"
    precision: Precision = "float32"
    steps: int = 128

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(2, "width", "depth")
        self.check_samples("steps")


@dataclass(frozen=True)
class FieldSettings(PlacedSettings):
    """What D-NeRF, Nerfies and HyperNeRF have in common.

    Attributes:
        sampling: ``hierarchical`` (coarse, then fine by weight) or ``occupancy`` (even steps where
            something may be).
        coarse: samples a ray before weights are known (hierarchical).
        fine: samples a ray that are drawn by weight (hierarchical).
        separate_coarse: whether coarse samples have a radiance field of their own, learned with the
            other one (hierarchical).
    """

    sampling: Literal["hierarchical", "occupancy"] = "hierarchical"
    coarse: int = 64
    fine: int = 128
    separate_coarse: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_samples("coarse", "fine")
        possible = self.sampling == "hierarchical" or not self.separate_coarse
        self.check(
            "separate_coarse", possible, "false, as sampling=occupancy has no coarse samples"
        )
