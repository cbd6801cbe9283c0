"""Scenes read from disk, with optical flow from their files or estimated."""

from __future__ import annotations

import logging
from collections.abc import Collection
from pathlib import Path

from devrf.data.datamodule import SceneDataModule
from devrf.data.flow_source import with_flow, with_forward_flow
from devrf.scenes.reader import SceneReader
from devrf.scenes.scene import Scene

log = logging.getLogger(__name__)


class RecordedDataModule(SceneDataModule):
    """A scene read from disk when it is first needed, its flow estimated if that is asked for."""

    def __init__(self, reader: SceneReader) -> None:
        """Say which reader reads the scene, and with which options."""
        super().__init__()
        self.reader = reader

    def load(self) -> Scene:
        """Read the scene, and estimate its optical flow if that is asked for."""
        scene = self.reader.read()
        if scene.kind == "inward":
            bounds, kind = scene.bounds, "world" if scene.space.is_linear else "contracted"
            log.info(
                "%s: %s space (%s), box from %s", scene.name, kind, bounds.reason, bounds.box_source
            )
            if scene.moves:
                log.info("%s: room for motion: %s", scene.name, bounds.source)
        return with_flow(scene, self.reader.flow, self._cache)

    def provide(self, priors: Collection[str]) -> None:
        """Read or estimate forward flow, if a method wants it."""
        scene, reader = self.scene, self.reader
        if "forward_flow" in priors and scene.dynamic.train.forward_flow is None and scene.moves:
            files = None
            if reader.wants_flow_files:
                files = reader.forward_flow(scene.dynamic.train)
            self.replace(with_forward_flow(scene, reader.flow, self._cache, files))

    @property
    def _cache(self) -> Path | None:
        """Where estimated flow is kept."""
        cache = self.reader.flow_cache
        return None if cache is None else Path(cache)
