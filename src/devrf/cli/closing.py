"""What a pipeline says at its end: where its results are, and what to try next."""

from __future__ import annotations

import logging
import shlex
from pathlib import Path

from devrf.cli import job

log = logging.getLogger(__name__)

# What a run's folder may hold that a person looks at first.
RESULTS = ("metrics.json", "images", "videos/orbit.mp4", "videos/spiral.mp4", "checkpoints")
NEXT = (
    "stage=still still.time=0.35 still.height=400",
    "stage=render video.frames=120",
    "stage=report",
)


def say_what_next(folder: Path) -> None:
    """Log where the results are, and commands that go on from them."""
    found = ", ".join(name for name in RESULTS if (folder / name).exists())
    log.info("results: %s (%s)", folder, found)
    log.info("next:")
    given = [word for word in job.overrides() if not word.startswith("stage=")]
    given += [word for word in job.hydra_overrides() if word.startswith("hydra.run.dir=")]
    for words in NEXT:
        chosen = [] if words == "stage=report" else given
        log.info("  %s", shlex.join(["python", "-m", "devrf", *chosen, *words.split()]))
