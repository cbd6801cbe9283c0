"""What a checkpoint holds beside a stage's tensors, and how a stage continues from it.

:mod:`devrf.checkpoints.progress` describes the whole way of a run that is stopped and resumed.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from devrf.checkpoints.checkpoint import MODEL, CheckpointMetadata, check_scene, metadata_in
from devrf.checkpoints.progress import rng_state
from devrf.checkpoints.viewpoints import Viewpoints
from devrf.errors import DevrfError
from devrf.rendering.view import Viewable

if TYPE_CHECKING:
    from devrf.engine.stage import ScheduledStage


class LearnedModel(Viewable, Protocol):
    """What a stage learns: a :class:`~devrf.methods.base.DynamicModel`."""

    def config(self) -> dict[str, Any]:
        """Plain data to build it from."""
        ...

    def stored_state(self) -> dict[str, Any]:
        """The state for a finished checkpoint."""
        ...


def metadata(stage: ScheduledStage) -> CheckpointMetadata:
    """The metadata of a checkpoint of the stage."""
    model = stage.scene_model
    target = f"{type(model).__module__}.{type(model).__qualname__}"
    return CheckpointMetadata(
        scene=stage.scene.name,
        fingerprint=stage.scene.fingerprint,
        stage=stage.name,
        model={"_target_": target, **model.config()},
        protocol=stage.protocol,
        records={**stage.earlier_records, stage.name: stage.record},
        training_config=stage.training_config,
        earlier_configs=stage.earlier_configs,
        command=stage.command,
        complete=stage.iteration >= stage.total_iterations,
    )


def save(stage: ScheduledStage, checkpoint: dict[str, Any]) -> None:
    """Add the state that is not in tensors to a checkpoint of Lightning's."""
    checkpoint["devrf"] = metadata(stage).as_data()
    checkpoint["viewpoints"] = Viewpoints.of(stage.scene).as_data()
    # Without the optimiser's state a checkpoint is for rendering, not for resuming.
    if "optimizer_states" not in checkpoint:
        if stage.iteration >= stage.total_iterations:
            compact = stage.finished_state()
            checkpoint["state_dict"] = {f"{MODEL}{k}": v for k, v in compact.items()}
        return
    checkpoint["progress"] = {
        "stage": stage.name,
        "iteration": stage.iteration,
        "skipped": stage.skipped,
        "total": stage.total_iterations,
        "phase": None if stage.phase is None else stage.phase.start,
        "phase_state": {} if stage.phase is None else stage.phase_state(),
        "seed": stage.seed,
        "random": rng_state(stage.device),
        "micro_batches": stage.loop.micro_batching.count,
        "num_rollbacks": stage.num_rollbacks,
        "lr_scale": stage.lr_scale,
    }


def load(stage: ScheduledStage, checkpoint: dict[str, Any], path: Path) -> dict[str, Any] | None:
    """Restore a stage's position in its schedule, before its tensors are loaded.

    Args:
        stage: the stage, after its setup.
        checkpoint: the content of the file.
        path: the file, for messages.

    Returns:
        What remains to be restored once the tensors are loaded (``phase_state``, ``random``); None
        for a checkpoint without the optimiser's state.

    Raises:
        DevrfError: the checkpoint is of another scene, stage or schedule.
    """
    check_scene(path, metadata_in(path, checkpoint), stage.scene)
    stage.resize_to(checkpoint["state_dict"])
    kept: dict[str, Any] | None = checkpoint.get("progress")
    if kept is None:
        return None
    course, ours = (kept["stage"], kept["total"]), (stage.name, stage.total_iterations)
    if course != ours:
        raise DevrfError(
            f"{path}: left by the {course[0]} stage on a schedule of {course[1]} iterations, "
            f"this is the {ours[0]} stage on one of {ours[1]}; give it its own schedule"
        )
    stage.iteration, stage.seed, stage.skipped = kept["iteration"], kept["seed"], kept["skipped"]
    stage.loop.micro_batching.count = kept["micro_batches"]
    stage.num_rollbacks, stage.lr_scale = kept["num_rollbacks"], kept["lr_scale"]
    stage.phase = None if kept["phase"] is None else stage.phase_at(kept["phase"])
    return kept
