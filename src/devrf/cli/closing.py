"""What a pipeline says at its end: where its results are, and what to try next."""

from __future__ import annotations

import logging
import os
import shlex
from pathlib import Path

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
    place = Path(os.path.relpath(folder)) if folder.is_relative_to(Path.cwd()) else folder
    log.info("results: %s (%s)", place, found)
    log.info("next:")
    for words in NEXT:
        chosen = [] if words == "stage=report" else [f"hydra.run.dir={place}"]
        log.info("  %s", shlex.join(["python", "-m", "devrf", *chosen, *words.split()]))
