"""Settings of NSFF, and the iterations at which its losses change."""

from __future__ import annotations

from dataclasses import field, replace
from typing import Annotated, ClassVar, Literal, Self

from annotated_types import Ge
from pydantic.dataclasses import dataclass

from devrf.methods.nerf.settings import MethodSettings, PlacedSettings, Samples
from devrf.system.options import Count, NotNegative, Positive, Whole


@dataclass(frozen=True)
class Warmup(MethodSettings):
    """N₀ iterations in which motion is begun, as data (docs/methods/nsff.md#schedule).

    Attributes:
        steps_per_frame: N₀ = steps_per_frame · (number of frames, within the two limits).
        min_frames: fewer frames count as so many.
        max_frames: more frames count as so many.
        chained_from: multiples of N₀ after which the term ``chained`` counts.
        prior_decay: divisor of depth and flow priors after each N₀.
    """

    key: ClassVar[str] = f"{MethodSettings.key}.warmup"

    steps_per_frame: Count = 1000
    min_frames: int = 30
    max_frames: int = 250
    chained_from: NotNegative = 2.0
    prior_decay: Annotated[float, Ge(1)] = 10.0

    def __post_init__(self) -> None:
        limit = self.max_frames
        self.check("min_frames", 1 <= self.min_frames <= limit, f"1 … max_frames ({limit})")

    def scaled(self, factor: float) -> Warmup:
        """The same in ``factor`` times the iterations."""
        return replace(self, steps_per_frame=max(1, round(self.steps_per_frame * factor)))

    def steps(self, frames: int) -> int:
        """N₀ of a scene of so many frames."""
        return self.steps_per_frame * min(max(frames, self.min_frames), self.max_frames)

    def prior_factor(self, step: int, frames: int) -> float:
        """Factor of the priors' weights at iteration ``step``: 1, then divided once every N₀."""
        return float(self.prior_decay ** -(step // self.steps(frames)))


@dataclass(frozen=True)
class NSFFSettings(PlacedSettings):
    """Sizes, sampling and blending; the defaults are the published ones (docs/methods/nsff.md).

    Attributes:
        density_noise: deviation of the noise that densities have while they are learned.
        flow_reach: the most that a point moves from a frame to the next along an axis, in halves of
            the box's longest edge; None: 1 in NDC, 0.2 elsewhere.
        blend: of static and dynamic densities: ``v`` (a learned share) or ``additive``.
        sampling: ``stratified`` (one sample in each of equal stretches of a ray) or ``occupancy``
            (even steps where something may be).
        samples: number of a ray's samples (stratified).
        neighbours: whether a ray is rendered from ``both`` neighbouring frames in each iteration,
            or from ``one`` at random.
        hard_rays: rays within the motion masks that a batch has beside the others in the first N₀
            iterations.
        warmup: the iterations at which the losses change.
    """

    rehearsal: ClassVar = {**PlacedSettings.rehearsal, "samples": 48, "hard_rays": 64}

    density_noise: NotNegative = 1.0
    flow_reach: Positive | None = None
    blend: Literal["v", "additive"] = "v"
    sampling: Literal["stratified", "occupancy"] = "stratified"
    samples: Samples = 128
    neighbours: Literal["both", "one"] = "both"
    hard_rays: Whole = 512
    warmup: Warmup = field(default_factory=Warmup)

    def rehearsed(self, factor: float) -> Self:
        """A shorter beginning, too."""
        return replace(super().rehearsed(factor), warmup=self.warmup.scaled(factor))
