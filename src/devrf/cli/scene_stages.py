"""Which of a protocol's stages a scene has images for: one at rest has none of motion."""

from __future__ import annotations

from collections.abc import Sequence

from devrf.cli.context import RunContext
from devrf.errors import DevrfError


def stages_with_images(run: RunContext) -> tuple[str, ...]:
    """The protocol's stages; of a scene at rest those that learn from the static set alone."""
    if run.scene.moves:
        return run.learning_stages
    return tuple(step.name for step in run.protocol.steps if step.capture == "static")


def learnable(run: RunContext, asked: Sequence[str]) -> tuple[str, ...]:
    """Those of the ``asked`` stages that the scene has images for; the scene is read.

    Raises:
        DevrfError: there is none.
    """
    known = stages_with_images(run)
    left = tuple(name for name in asked if name in known)
    if left:
        return left
    what = f"{run.scene.name} is at rest: all its images show one moment"
    if known:
        raise DevrfError(
            f"stage={asked[0]}: learns motion, but {what}; use stage={known[0]} or stage=pipeline"
        )
    raise DevrfError(
        f"protocol={run.protocol.name}: learns from images in motion, but {what}; use "
        "protocol=two_stage"
    )
