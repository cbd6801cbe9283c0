"""Checkpoints that know what they are: sealed, and read without running code."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lightning import Trainer
from lightning.fabric.plugins import CheckpointIO

from devrf.checkpoints.checkpoint_file import read_checkpoint_file, write_checkpoint_file
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD, Space
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.compact_state import expanded_state
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.model import SceneModel
from devrf.methods.devrf.volume_rendering import RenderSettings
from devrf.rendering.occupancy import Occupancy
from devrf.scenes.scene import Scene


@dataclass(frozen=True)
class CheckpointMetadata:
    """What a checkpoint says of itself, in plain data.

    Attributes:
        scene: the scene's name.
        fingerprint: the scene's cameras, times and image sizes, hashed.
        architecture: sizes of the canonical field.
        settings: how rays are sampled.
        space: the space that the fields live in.
        records: what training took, by stage.
        training_config: the settings that decided what was learned, by config key; empty where
            nobody told (a stage that was not trained from a config).
        complete: whether the stage's schedule has come to its end.
    """

    scene: str
    fingerprint: str
    architecture: Architecture
    settings: RenderSettings
    space: Space = WORLD
    records: dict[str, dict[str, float | None]] = field(default_factory=dict)
    training_config: dict[str, Any] = field(default_factory=dict)
    complete: bool = True


@dataclass(frozen=True)
class LoadedCheckpoint:
    """A learned scene and where it came from.

    Attributes:
        metadata: which scene, and how it was learned.
        model: the scene, ready to render.
    """

    metadata: CheckpointMetadata
    model: SceneModel


class ChecksummedCheckpointIO(CheckpointIO):
    """How Lightning writes and reads checkpoints here: sealed files."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write ``checkpoint`` to ``path``, whole or not at all."""
        write_checkpoint_file(Path(path), checkpoint)

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a sealed file onto the host; whatever the other arguments ask, no code is run."""
        return read_checkpoint_file(Path(path))

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove the file."""
        Path(path).unlink(missing_ok=True)


def save_checkpoint(trainer: Trainer, path: Path, *, weights_only: bool = True) -> None:
    """Write what the trainer's stage has learned; an earlier file stays until the new is whole.

    Args:
        trainer: has the stage.
        path: the file.
        weights_only: False adds all that it takes to go on learning from there.

    Raises:
        OSError: the file cannot be written.
    """
    strategy = trainer.strategy
    usual, strategy.checkpoint_io = strategy.checkpoint_io, ChecksummedCheckpointIO()
    try:
        trainer.save_checkpoint(path, weights_only=weights_only)
    finally:
        strategy.checkpoint_io = usual


def load_checkpoint(path: Path, scene: Scene | None = None) -> LoadedCheckpoint:
    """Read a learned scene, on the host.

    Args:
        path: a checkpoint of either stage.
        scene: the scene it must belong to; None takes any.

    Raises:
        DevrfError: no such file, a damaged one, not a devrf checkpoint, one of another format, or
            of another scene.
    """
    if not path.is_file():
        raise DevrfError(f"{path}: no such checkpoint; run the stage that makes it, or set ckpt")
    data = read_checkpoint_file(path)
    metadata = metadata_in(path, data)
    if scene is not None:
        check_scene(path, metadata, scene)
    state = data.get("state_dict")
    return LoadedCheckpoint(
        metadata, _model(path, metadata, state if isinstance(state, dict) else {})
    )


def check_scene(path: Path, metadata: CheckpointMetadata, scene: Scene) -> None:
    """Check that a checkpoint belongs to ``scene``.

    Raises:
        DevrfError: it does not.
    """
    if metadata.fingerprint != scene.fingerprint:
        raise DevrfError(
            f"{path}: belongs to another scene ({metadata.scene}: other cameras, times or image "
            f"sizes than {scene.name}); train this scene, or set ckpt to its own checkpoint"
        )


def metadata_in(path: Path, data: dict[str, Any]) -> CheckpointMetadata:
    """The metadata in the content of a checkpoint.

    Raises:
        DevrfError: there is none that is understood here.
    """
    if not isinstance(data, dict) or not isinstance(data.get("devrf"), dict):
        raise DevrfError(f"{path}: not a devrf checkpoint; set ckpt to one that devrf wrote")
    stored = data["devrf"]
    try:
        return CheckpointMetadata(
            scene=stored["scene"],
            fingerprint=stored["fingerprint"],
            architecture=Architecture(**stored["architecture"]),
            settings=RenderSettings(**stored["settings"]),
            space=NormalizedDevice(**stored["space"]) if stored["space"] else WORLD,
            records=stored["records"],
            training_config=stored["training_config"],
            complete=stored["complete"],
        )
    except (KeyError, TypeError) as error:
        raise DevrfError(
            f"{path}: its description lacks or has an unknown entry ({error}); train again"
        ) from None


def _model(path: Path, metadata: CheckpointMetadata, state: dict[str, Any]) -> SceneModel:
    """Build a model of any size and let the stored state give it its shapes."""
    box = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    own = {str(k).removeprefix("scene_model."): v for k, v in state.items()}
    build = metadata.architecture
    # A stage that was stopped in its search has no decoder yet.
    searched = not any(key.startswith("canonical.decoder.") for key in own)
    model = SceneModel(
        build.search_field(box, 8) if searched else build.radiance_field(box, 8, 8),
        Occupancy.full((2, 2, 2), box),
        metadata.settings,
        space=metadata.space,
    )
    if any(key.startswith("deformation.") for key in own):
        model.deformation = DeformationField(box, FrameClock((0.0, 1.0)), voxels=8)
    try:
        model.load_state_dict(expanded_state(own))
    except (RuntimeError, KeyError, ValueError, TypeError, AttributeError):
        raise DevrfError(f"{path}: its fields do not fit its description; train again") from None
    return model
