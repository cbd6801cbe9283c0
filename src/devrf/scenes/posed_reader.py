"""Posed images that say where their scene is, seen from all around or from one side."""

from __future__ import annotations

from dataclasses import KW_ONLY, replace
from pathlib import Path
from typing import Literal

from pydantic.dataclasses import dataclass

from devrf.scenes.inward_space import SpaceChoice
from devrf.scenes.one_sided import centred, one_sided_scene
from devrf.scenes.reader import InwardReader
from devrf.scenes.scene import Capture, Scene
from devrf.scenes.transforms import SceneBounds
from devrf.scenes.validation import scene_error


@dataclass(frozen=True)
class PosedReader(InwardReader):
    """Options of layouts that may state bounds.

    Attributes:
        space: as of :class:`~devrf.scenes.reader.InwardReader`, or ``ndc`` for cameras that face
            the scene from one side: then the world is that of their average pose, ``near`` is
            the near plane, and the scene is a forward-facing one. Stated bounds say what ``auto``
            is, and ``near``, ``far`` and ``box`` where they are None.
    """

    _: KW_ONLY
    space: SpaceChoice | Literal["ndc"] = "auto"  # type: ignore[assignment]

    def placed(
        self,
        folder: Path,
        static: Capture,
        dynamic: Capture,
        stated: SceneBounds | None,
        source: str,
    ) -> Scene:
        """The scene of two captures.

        Args:
            folder: where they were read from.
            static: the scene at rest.
            dynamic: the scene in motion; ``static`` itself where it is always at rest.
            stated: where the scene is, if that is known.
            source: what states it, in words.

        Raises:
            DevrfError: the options, or the cameras, do not say where it is.
        """
        reader = _with_bounds(self, stated)
        if reader.space != "ndc":
            scene = reader.scene(folder, static, dynamic)
            reason = scene.bounds.reason if reader.space == self.space else source
            found = self.box is None and reader.box is not None
            box_source = source if found else scene.bounds.box_source
            bounds = replace(scene.bounds, reason=reason, box_source=box_source)
            return replace(scene, bounds=bounds)
        if reader.near is None or reader.near <= 0:
            raise scene_error(
                "data.near",
                "data.space=ndc needs the distance of the near plane, above 0; give it in world "
                "units, a little less than the depth of what is nearest",
            )
        name, captures = self.name_of(folder), centred(static, dynamic)
        return one_sided_scene(name, *captures, reader.near, self.background)


def _with_bounds(options: PosedReader, stated: SceneBounds | None) -> PosedReader:
    """The options, with what is stated where they leave it open."""
    if stated is None:
        return options
    space = stated.space if options.space == "auto" else options.space
    if (space == "ndc") != (stated.space == "ndc"):  # in another world, or of other meaning
        return replace(options, space=space)
    box = stated.box if options.box is None and options.space == "auto" else options.box
    near = stated.near if options.near is None else options.near
    far = stated.far if options.far is None else options.far
    return replace(options, space=space, near=near, far=far, box=box)
