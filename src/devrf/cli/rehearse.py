"""``rehearse=true``: all that a run does, at sizes for minutes on a CPU, and its results.

The settings are the run's own. Its schedules are scaled, so that every event happens in its order;
batches, grids, networks and images are smaller (:meth:`~devrf.engine.stage.Stage.rehearsed`). Its
result is no run: it has a folder of its own, ``rehearsal.json`` in place of ``metrics.json``, so
that no report compares it, and checkpoints that no run goes on with. It begins anew each time.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence

from devrf.apps.inspection.report import show
from devrf.apps.rehearsal import learned, record, rehearsal_tables, shortfalls
from devrf.apps.settings import REHEARSAL
from devrf.checkpoints.checkpoint import metadata_of
from devrf.checkpoints.progress import progress_files
from devrf.cli.context import RunContext
from devrf.cli.memory import table_of_needs
from devrf.errors import DevrfError
from devrf.system.files import read_record, write_json

log = logging.getLogger(__name__)

# The setting that tells a rehearsal's checkpoints from a run's.
KEY = "rehearse"


def begin_anew(run: RunContext, learning: Sequence[str]) -> None:
    """Remove an earlier rehearsal's checkpoints of these stages and later ones in the folder.

    Raises:
        DevrfError: a run's own checkpoints are there.
    """
    for path in sorted((run.folder / "checkpoints").glob("*.ckpt")):
        if KEY not in metadata_of(path).training_config:
            raise DevrfError(
                f"{path}: of a run; a rehearsal needs a folder of its own, hydra.run.dir=FOLDER"
            )
    for name in run.learning_stages[run.learning_stages.index(learning[0]) :]:
        own = run.own_checkpoint(name)
        for path in (own, *progress_files(own.parent, name)):
            path.unlink(missing_ok=True)


def conclude(run: RunContext) -> None:
    """Show each stage's results, and the needs of the run itself; write them to the record.

    Raises:
        DevrfError: a stage has learned nothing, or a planned event did not take place.
    """
    path = run.folder / REHEARSAL
    scores = json.loads(read_record(path))
    model = run.load(scene=run.scene).model
    captures = [name for name in run.scene.captures if name in scores]
    reached = {capture: learned(model, run.scene, capture) for capture in captures}
    held_out = {capture: scores[capture]["psnr"] for capture in captures}
    assert run.whole_scene is not None
    rows = table_of_needs(run, run.whole_scene)
    show(rehearsal_tables(run.rehearsed, reached, held_out, rows))
    reasons = shortfalls(run.rehearsed, reached)
    write_json(path, {**scores, "rehearsal": record(run.rehearsed, reached, reasons)})
    if reasons:
        raise DevrfError(f"rehearse: {'; '.join(reasons)}; {path} has the figures")
    log.info("rehearsed: every stage learns, and all that is planned takes place (%s)", path)
