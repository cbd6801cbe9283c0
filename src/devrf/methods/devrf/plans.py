"""Plans of DeVRF's stages before they are built: kernels, iterations, memory, rehearsals.

Memory is estimated for fields at their final resolution, about side³ voxels in any box.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from warp import Kernel

from devrf.engine.needs import LEARNED, SIZE, StageNeeds, tensor_bytes
from devrf.engine.plan import StagePlan
from devrf.geometry.ndc import NormalizedDevice
from devrf.kernels.ahead import grid_kernels, march_kernels
from devrf.methods.devrf.architecture import Architecture, fitted_to
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.deformation_loss import DeformationLoss
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Visits
from devrf.methods.devrf.settings import VisitSettings
from devrf.scenes.scene import Scene

# Measured around a free-standing object: the share of a ray's samples that are occupied, and of
# these the share whose colour counts once surfaces have formed.
OCCUPIED, COLOURED = 0.3, 0.25
# A rehearsal of the canonical stage has at most so many iterations, units of a layer, and voxels
# along an edge; one of the deformation stage so many iterations of a frame, and voxels along an
# edge, and moves a voxel in a step by so much of the box's longest edge. Both have so many rays.
REHEARSED_ITERATIONS = 600
REHEARSED_WIDTH = 64
REHEARSED_SIDE = 48
REHEARSED_SEARCH_SIDE = 40
REHEARSED_FRAME_ITERATIONS = 25
REHEARSED_DISPLACEMENT_SIDE = 40
REHEARSED_RATE = 1e-2
REHEARSED_RAYS = 256


class CanonicalPlan(StagePlan):
    """The plan of the canonical stage."""

    @property
    def kernels(self) -> Sequence[Kernel]:
        """Of both stages: the march, and look-ups of features, search colours, displacements."""
        architecture: Architecture = self.settings["architecture"]
        return [*march_kernels(), *grid_kernels({3, architecture.channels})]

    def iterations(self, scene: Scene) -> int:
        """Of search and radiance field; contracted space has no search."""
        schedule: CanonicalSchedule = self.settings["schedule"]
        return schedule.in_space(scene.space).total

    def needs(self, scene: Scene, earlier: StagePlan | None) -> StageNeeds:
        """Images, grids and a batch."""
        grid, values, ray = _field(self.settings, scene)
        parts = {
            SIZE: tensor_bytes(scene.static.train),
            grid: LEARNED * values,
            "schedule.canonical.rays": self.settings["schedule"].rays * ray,
        }
        return StageNeeds(parts, {grid: values})

    def rehearsed(self) -> CanonicalPlan:
        """Grids of few voxels, and a search that begins as much less faint as it is shorter."""
        schedule: CanonicalSchedule = self.settings["schedule"]
        architecture: Architecture = self.settings["architecture"]
        factor = min(1.0, REHEARSED_ITERATIONS / schedule.total)
        planes = architecture.planes
        return self.with_settings(
            schedule=replace(
                schedule.scaled(factor),
                search_side=min(schedule.search_side, REHEARSED_SEARCH_SIDE),
                side=min(schedule.side, REHEARSED_SIDE),
                rays=min(schedule.rays, REHEARSED_RAYS),
            ),
            architecture=replace(
                architecture.for_search(factor),
                width=min(architecture.width, REHEARSED_WIDTH),
                planes=planes and min(planes, REHEARSED_SIDE),
            ),
            iterations_per_step=min(self.settings["iterations_per_step"], 10),
        )


class DeformationPlan(StagePlan):
    """The plan of the deformation stage, which builds on a canonical one."""

    def check(self) -> None:
        """Check the loss, too."""
        super().check()
        extensions = tuple(self.settings.get("extensions", {}).values())
        DeformationLoss(self.settings["loss"], extensions, self.settings["schedule"])

    def iterations(self, scene: Scene) -> int:
        """Of all levels and frames."""
        schedule: DeformationSchedule = self.settings["schedule"]
        return Visits(schedule, len(scene.clock)).total

    def needs(self, scene: Scene, earlier: StagePlan | None) -> StageNeeds:
        """Images, the frozen field, the displacement grids, and a batch."""
        assert earlier is not None, "it builds on the canonical stage"
        schedule: DeformationSchedule = self.settings["schedule"]
        grid, values, ray = _field(earlier.settings, scene)
        # Displacements of a frame: three numbers in both directions. The active one is learned.
        frame, frames = 24 * schedule.levels[-1].side ** 3, len(scene.clock)
        on_device = 1 if self.settings["visit"].store == "host" else frames
        side = f"schedule.deformation.levels.{len(schedule.levels)}.side"
        parts = {
            SIZE: tensor_bytes(scene.dynamic.train),
            grid: values,
            side: frame * (on_device + LEARNED),
            "schedule.deformation.rays": schedule.rays * COLOURED * ray,
        }
        return StageNeeds(parts, {grid: values, side: frames * frame})

    def rehearsed(self) -> DeformationPlan:
        """Few iterations of each frame, in which voxels move as far, on grids of few."""
        schedule: DeformationSchedule = self.settings["schedule"]
        whole = sum(row.iterations for row in schedule.levels)
        factor = min(1.0, REHEARSED_FRAME_ITERATIONS / whole)
        scaled = schedule.scaled(factor).with_finest(REHEARSED_DISPLACEMENT_SIDE)
        visit: VisitSettings = self.settings["visit"].scaled(factor)
        if visit.unit == "box":  # of which a step is a small part
            visit = replace(visit, learning_rate=min(visit.learning_rate, REHEARSED_RATE))
        return self.with_settings(
            schedule=replace(scaled, rays=min(schedule.rays, REHEARSED_RAYS)),
            visit=visit,
            iterations_per_step=min(self.settings["iterations_per_step"], 10),
        )


def _field(canonical: Mapping[str, Any], scene: Scene) -> tuple[str, float, float]:
    """The key of the canonical grids' size, and the bytes of their values and of a ray."""
    schedule, sizes = fitted_to(scene, canonical["schedule"], canonical["architecture"])
    # With the graph of its gradients: measured, for each sample whose colour counts.
    sample = 600 + 24 * sizes.width + 96 * sizes.channels
    along = 2 / 3 * schedule.side * OCCUPIED if sizes.planes is None else sizes.planes
    by_pixels = schedule.voxels_per_pixel is not None and isinstance(scene.space, NormalizedDevice)
    key = f"schedule.canonical.{'voxels_per_pixel' if by_pixels else 'side'}"
    values = 4 * (1 + sizes.channels) * schedule.side**3
    return key, values, along / canonical["sampling"].step * sample
