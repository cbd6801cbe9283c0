"""What a checkpoint says beside a stage's tensors, and how a stage goes on from it.

How a run survives being killed, from end to end:

* ``callbacks.PeriodicCheckpoint`` writes a progress file every so often, between two Lightning
  steps, and when it is asked to stop. It is a Lightning checkpoint: the fields at their present
  resolution (state_dict), the optimiser (moments, step counts, rates, which entries it skips),
  Lightning's loop (so that curves go on in step), and what the callbacks remember (seconds,
  memory).
* :func:`save` adds the rest: the iteration, the phase that the grids are ready for, every random
  state, and what the phase works with that its schedule alone does not tell
  (:meth:`~devrf.engine.stage.ScheduledStage.phase_state`): the pixels to draw from, and the
  occupancy of the active frames.
* ``checkpoints.checkpoint_file`` writes it whole or not at all, with a checksum.
* ``Trainer.fit(ckpt_path=…)`` reads it. The stage is set up as at its beginning and takes its
  fields' shapes from the file; the optimiser is given the grids, then its state; the random
  states are set last, when nothing but the next iteration can draw from them.
* ``cli.resume`` finds the file, and checks that it was made with the settings of today.

A finished stage leaves one checkpoint without any of this, and its progress files go.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from devrf.checkpoints.checkpoint import MODEL, CheckpointMetadata, check_scene, metadata_in
from devrf.checkpoints.progress import rng_state
from devrf.errors import DevrfError

if TYPE_CHECKING:
    from devrf.engine.stage import ScheduledStage


def metadata(stage: ScheduledStage) -> CheckpointMetadata:
    """What a checkpoint of the stage says of itself."""
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
        complete=stage.iteration >= stage.total_iterations,
    )


def save(stage: ScheduledStage, checkpoint: dict[str, Any]) -> None:
    """Add what the tensors do not tell to a checkpoint of Lightning's."""
    checkpoint["devrf"] = metadata(stage).as_data()
    # Without the optimiser's state it is there to be rendered, not to be gone on from.
    if "optimizer_states" not in checkpoint:
        if stage.iteration >= stage.total_iterations:
            small = stage.current_model().stored_state()
            checkpoint["state_dict"] = {f"{MODEL}{k}": v for k, v in small.items()}
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
    """Put a stage where a checkpoint left it; its tensors come next.

    Args:
        stage: has been set up.
        checkpoint: the content of a file.
        path: the file, for messages.

    Returns:
        What is left to restore once the tensors are there: ``phase_state`` and ``random``; None
        of a checkpoint that nothing can be gone on from.

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
