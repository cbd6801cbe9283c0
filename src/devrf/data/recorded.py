"""Scenes read from disk, with optical flow from their files or estimated."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

from devrf.data.datamodule import SceneDataModule
from devrf.data.exposure import with_equal_exposure
from devrf.data.flow import with_flow, with_forward_flow
from devrf.errors import DevrfError
from devrf.scenes.formats import check_choice
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.colmap import ColmapReader
from devrf.scenes.formats.dycheck import DycheckReader
from devrf.scenes.formats.easyvolcap import EasyVolcapReader
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.formats.nerfies import NerfiesReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.formats.neural_3d_video import Neural3DVideoReader
from devrf.scenes.formats.panoptic import PanopticReader
from devrf.scenes.reader import SceneReader
from devrf.scenes.scene import Scene

log = logging.getLogger(__name__)

# By the option of ``data=``.
READERS: dict[str, type[SceneReader]] = {
    "inward": BlenderReader,
    "forward": LlffReader,
    "nerfies": NerfiesReader,
    "nerfstudio": NerfstudioReader,
    "colmap": ColmapReader,
    "neural_3d_video": Neural3DVideoReader,
    "dycheck": DycheckReader,
    "panoptic": PanopticReader,
    "easyvolcap": EasyVolcapReader,
}


class RecordedDataModule(SceneDataModule):
    """A scene that is read from disk when it is first needed."""

    def __init__(self, reader: Callable[..., SceneReader], *where: Any, **options: Any) -> None:
        """Choose the reader and its options.

        Args:
            reader: one of :data:`READERS`, or another.
            where: the scene's folder.
            options: the reader's.
        """
        super().__init__()
        self.reader = reader(*where, **options)

    def load(self) -> Scene:
        """Read the scene, and estimate its optical flow if ``data.flow`` says so."""
        if self.validation:
            self.reader = replace(self.reader, validation=True)
        try:
            scene = self.reader.read()
        except DevrfError:
            for choice, reader in READERS.items():
                if type(self.reader) is reader:
                    check_choice(self.reader.root, choice)
            raise
        self.downscale = self.reader.factor
        if scene.kind == "inward":
            bounds = scene.bounds
            kind = "world" if scene.space.is_linear else "contracted"
            log.info(
                "%s: %s space (%s), box from %s", scene.name, kind, bounds.reason, bounds.box_source
            )
            if scene.moves:
                log.info("%s: room for motion: %s", scene.name, bounds.source)
        scene = with_equal_exposure(scene, self.reader.exposure)
        return with_flow(scene, self.reader.flow, self.reader.flow_cache)

    def provide(self, priors: Collection[str]) -> None:
        """Read or estimate forward flow, if a method needs it."""
        scene = self.scene
        reader = self.reader
        if "forward_flow" in priors and scene.dynamic.train.forward_flow is None and scene.moves:
            files = None
            if reader.wants_flow_files:
                files = reader.forward_flow(scene.dynamic.train)
            self.replace(with_forward_flow(scene, reader.flow, reader.flow_cache, files))


class InwardFacingDataModule(RecordedDataModule):
    """A scene that cameras look in at, in DeVRF's published Blender layout or D-NeRF's."""

    def __init__(
        self, *where: Any, reader: Callable[..., SceneReader] = BlenderReader, **options: Any
    ) -> None:
        """Choose the scene and the options of its reader; see :class:`BlenderReader`."""
        super().__init__(reader, *where, **options)


class ForwardFacingDataModule(RecordedDataModule):
    """A scene that cameras face from one side, in DeVRF's published layout or LLFF's."""

    def __init__(
        self, *where: Any, reader: Callable[..., SceneReader] = LlffReader, **options: Any
    ) -> None:
        """Choose the scene and the options of its reader; see :class:`LlffReader`."""
        super().__init__(reader, *where, **options)
