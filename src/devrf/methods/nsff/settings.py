"""What can be chosen of NSFF, and when its losses change."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from devrf.errors import DevrfError
from devrf.methods.nerf.settings import check_empty_from


@dataclass(frozen=True)
class Warmup:
    """N₀ iterations in which motion is begun, as data (docs/methods/nsff.md#schedule).

    Attributes:
        steps_per_frame: N₀ = steps_per_frame · (number of frames, within the two limits).
        min_frames: fewer frames count as so many.
        max_frames: more frames count as so many.
        chained_from: after how many times N₀ the term ``chained`` counts.
        prior_decay: by what depth and flow priors are divided after each N₀.
    """

    steps_per_frame: int = 1000
    min_frames: int = 30
    max_frames: int = 250
    chained_from: float = 2.0
    prior_decay: float = 10.0

    def __post_init__(self) -> None:
        key = "ray_stage.model.settings.warmup"
        if self.steps_per_frame < 1:
            raise DevrfError(
                f"{key}.steps_per_frame: expected at least 1, not {self.steps_per_frame}"
            )
        if not 1 <= self.min_frames <= self.max_frames:
            raise DevrfError(
                f"{key}.min_frames: expected 1 … max_frames ({self.max_frames}), not "
                f"{self.min_frames}"
            )
        if self.prior_decay < 1:
            raise DevrfError(f"{key}.prior_decay: expected at least 1, not {self.prior_decay}")

    def steps(self, frames: int) -> int:
        """N₀ of a scene of so many frames."""
        return self.steps_per_frame * min(max(frames, self.min_frames), self.max_frames)

    def prior_factor(self, step: int, frames: int) -> float:
        """Factor of the priors' weights at iteration ``step``: 1, then divided once every N₀."""
        return float(self.prior_decay ** -(step // self.steps(frames)))


@dataclass(frozen=True)
class NSFFSettings:
    """Sizes, sampling and blending; the defaults are the published ones (docs/methods/nsff.md).

    Attributes:
        width: units of each layer of both trunks.
        depth: layers of each trunk.
        skip: the layer, counted from 0, that the input enters again; None: the middle one.
        bands: octaves of positions and times.
        direction_bands: octaves of viewing directions.
        density_scale: density of a softplus of 1, per half of the box's longest edge.
        density_noise: deviation of the noise that densities have while they are learned.
        flow_reach: the most that a point moves from a frame to the next along an axis, in halves of
            the box's longest edge; None: 1 in NDC, 0.2 elsewhere.
        blend: how static and dynamic densities join: ``v`` (a learned share) or ``additive``.
        sampling: ``stratified`` (one sample in each of equal stretches of a ray) or ``occupancy``
            (even steps where something may be).
        samples: of a ray (stratified).
        steps: samples along the box's diagonal (occupancy).
        occupancy_side: the masks have about side³ cells (occupancy).
        hull: whether these are the visual hulls of each frame's masks, where there are any, which
            the published method never had (occupancy).
        empty_from: where there are no such hulls, space that the fields leave empty at all times
            is left out after this share of a stage; None: never (occupancy).
        neighbours: whether a ray is rendered from ``both`` neighbouring frames in each iteration,
            or from ``one`` at random.
        hard_rays: rays within the motion masks that a batch has beside the others in the first N₀
            iterations.
        precision: what the trunks compute in while they learn: float32, bfloat16, or ``auto``
            (bfloat16 on a GPU that multiplies it). All else is in float32.
        warmup: when the losses change.
    """

    width: int = 256
    depth: int = 8
    skip: int | None = 5
    bands: int = 10
    direction_bands: int = 4
    density_scale: float = 10.0
    density_noise: float = 1.0
    flow_reach: float | None = None
    blend: Literal["v", "additive"] = "v"
    sampling: Literal["stratified", "occupancy"] = "stratified"
    samples: int = 128
    steps: int = 128
    occupancy_side: int = 128
    hull: bool = True
    empty_from: float | None = 0.25
    neighbours: Literal["both", "one"] = "both"
    hard_rays: int = 512
    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    warmup: Warmup = field(default_factory=Warmup)

    def __post_init__(self) -> None:
        key = "ray_stage.model.settings"
        for name in ("width", "depth", "samples", "steps", "occupancy_side"):
            if getattr(self, name) < 2:
                raise DevrfError(f"{key}.{name}: expected at least 2, not {getattr(self, name)}")
        for name in ("hard_rays", "density_noise"):
            if getattr(self, name) < 0:
                raise DevrfError(f"{key}.{name}: expected 0 or more, not {getattr(self, name)}")
        check_empty_from(key, self.empty_from)
        if self.flow_reach is not None and self.flow_reach <= 0:
            raise DevrfError(f"{key}.flow_reach: expected more than 0, not {self.flow_reach}")
