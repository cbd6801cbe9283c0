"""Spaces as plain data, for checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD, Space

KINDS: dict[str, type[NormalizedDevice] | type[ContractedSpace]] = {
    "ndc": NormalizedDevice,
    "contracted": ContractedSpace,
}


def space_config(space: Space) -> dict[str, Any]:
    """A space as plain data with its ``kind``; the world is empty."""
    for kind, known in KINDS.items():
        if isinstance(space, known):
            return {"kind": kind, **asdict(space)}
    return {}


def space_from(config: Mapping[str, Any]) -> Space:
    """The space that :func:`space_config` described.

    Files from before there was a ``kind`` hold NDC, or the world.
    """
    if not config:
        return WORLD
    values = dict(config)
    space: Space = KINDS[values.pop("kind", "ndc")](**values)
    return space
