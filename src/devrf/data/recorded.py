"""Scenes that a reader brings from disk, with their optical flow from wherever it comes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import get_args

from devrf.data.datamodule import SceneDataModule
from devrf.data.flow_source import FlowSource, with_flow
from devrf.scenes.scene import Scene
from devrf.scenes.validation import check_choice

log = logging.getLogger(__name__)


class RecordedDataModule(SceneDataModule):
    """A scene read from disk when it is first needed, its flow estimated if that is asked for."""

    def __init__(
        self,
        read: Callable[[], Scene],
        flow: FlowSource,
        flow_cache: str | Path | None,
        flows: tuple[str, ...] = get_args(FlowSource),
    ) -> None:
        """Say how to read the scene.

        Args:
            read: reads it.
            flow: where its optical flow comes from.
            flow_cache: an ``.npz`` that keeps estimated flow; None estimates it every time.
            flows: what ``flow`` may be in this layout.
        """
        super().__init__()
        check_choice("data.flow", flow, flows)
        self.flow = flow
        self.flow_cache = None if flow_cache is None else Path(flow_cache)
        self._read = read

    def load(self) -> Scene:
        """Read the scene, and estimate its optical flow if that is asked for."""
        scene = self._read()
        if scene.kind == "inward":
            log.info("%s: box for motion from %s", scene.name, scene.bounds.source)
        return with_flow(scene, self.flow, self.flow_cache)
