"""Provenance of a stage's result: settings, records and earlier stages, for its checkpoints."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from devrf.checkpoints.checkpoint import CheckpointMetadata, TrainingFigures
from devrf.rendering.renderable import Renderable
from devrf.scenes.scene import Scene
from devrf.system.stored_class import class_path


@dataclass
class Provenance:
    """Where a stage's result comes from.

    Attributes:
        record: time, iterations and memory, once a ``TrainingRecord`` callback has measured them.
        earlier_records: the same of the stages that this one builds on, by name.
        training_config: the settings that decide what is learned, by config key; empty for a
            stage that was not built from a config.
        earlier_configs: the same of the stages that this one builds on, by name.
        command: choices and overrides of the command that learns.
        protocol: the name of the protocol that the stage is a part of, if any.
    """

    record: TrainingFigures = field(default_factory=dict)
    earlier_records: dict[str, TrainingFigures] = field(default_factory=dict)
    training_config: dict[str, Any] = field(default_factory=dict)
    earlier_configs: dict[str, dict[str, Any]] = field(default_factory=dict)
    command: dict[str, Any] = field(default_factory=dict)
    protocol: str | None = None

    def metadata(
        self, stage: str, model: Renderable, scene: Scene, *, complete: bool
    ) -> CheckpointMetadata:
        """Metadata of a checkpoint of ``model``, learned by ``stage`` from ``scene``."""
        return CheckpointMetadata(
            scene=scene.name,
            fingerprint=scene.fingerprint,
            stage=stage,
            model={"class": class_path(type(model)), **model.config()},
            protocol=self.protocol,
            records={**self.earlier_records, stage: self.record},
            training_config=self.training_config,
            earlier_configs=self.earlier_configs,
            command=self.command,
            complete=complete,
            moves=scene.moves,
            look=scene.look,
        )
