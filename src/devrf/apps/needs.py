"""Memory that a run needs of the host, and of smaller images; for people, a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from torch import Tensor

from devrf.engine.needs import StageNeeds, tensor_bytes
from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.scene import Scene

# Python and its libraries on the host; measured, as is the freed memory that the C library keeps.
PROGRAM, FRAGMENTATION = 600_000_000, 1.3


def smaller(scene: Scene, by: float) -> Scene:
    """A stand-in for a scene of images smaller by ``by``: its images are corners of theirs."""

    def corner(of_views: Any) -> Any:
        if not isinstance(of_views, Tensor) or of_views.ndim < 3:
            return of_views
        return of_views[:, : int(of_views.shape[1] / by), : int(of_views.shape[2] / by)]

    captures = [
        capture.mapped(lambda views: views.mapped(corner))
        for capture in (scene.static, scene.dynamic)
    ]
    space = scene.space
    if isinstance(space, NormalizedDevice):
        size = {"width": round(space.width / by), "height": round(space.height / by)}
        space = replace(space, **size, focal=(space.focal[0] / by, space.focal[1] / by))
    return replace(scene, static=captures[0], dynamic=captures[1], space=space)


def host_bytes(
    scene: Scene, stages: Iterable[StageNeeds], *, on_host: bool, batch_share: float = 1.0
) -> float:
    """Bytes that stages need of the host.

    The host trains with ``batch_share`` of each batch (``on_host``), or holds a GPU's results.
    """
    held = (FRAGMENTATION * s.peak(batch_share) if on_host else 2 * s.learned for s in stages)
    return PROGRAM + tensor_bytes(scene.captures.values()) + max(held)


def needs_table(scene: Scene, stages: Mapping[str, StageNeeds]) -> list[tuple[str, float]]:
    """Needs of ``stages``, for people: names and bytes."""
    return [
        *((f"GPU, {name} stage", stage.peak()) for name, stage in stages.items()),
        ("host, beside a GPU", host_bytes(scene, stages.values(), on_host=False)),
        ("host, without a GPU", host_bytes(scene, stages.values(), on_host=True)),
        ("checkpoint", max(stage.learned for stage in stages.values())),
    ]
