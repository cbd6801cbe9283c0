"""The step that downloads a public scene: ``stage=fetch``."""

from __future__ import annotations

import logging
import shlex
import sys
from pathlib import Path

from hydra.utils import instantiate

from devrf.cli.context import RunContext
from devrf.scenes.fetch import (
    RECORD,
    Fetched,
    FetchSettings,
    PublishedScene,
    fetch_scene,
    fetched_before,
    published_scene,
)

log = logging.getLogger(__name__)


def fetch(run: RunContext) -> None:
    """Download the scene ``scene=…`` into ``fetch.into``, and say what to do with it."""
    settings: FetchSettings = instantiate(run.config.fetch)
    scene = published_scene(run.config.scene, settings.catalogue)
    into = Path(settings.into).expanduser()
    there = fetched_before(scene, into)
    _conclude(scene, there or _fetch(scene, into, settings.sha256))


def _fetch(scene: PublishedScene, into: Path, sha256: str | None) -> Fetched:
    source = scene.collection
    log.info("%s: %s; from %s; licence: %s", scene.name, scene.about, source.page, source.licence)
    return fetch_scene(scene, into, sha256, progress=sys.stderr.isatty())


def _conclude(scene: PublishedScene, done: Fetched) -> None:
    log.info("%s: %s", scene.name, f"in {done.path}" if done.anew else f"is in {done.path} already")
    if done.compared:
        log.info("SHA-256 %s, as expected", done.sha256)
    else:
        log.info(
            "SHA-256 %s: none was known to compare it with; kept in %s",
            done.sha256,
            done.path / RECORD,
        )
    given = [f"data.root={done.path}"]
    log.info("next:")
    for first in (["stage=inspect"], scene.collection.learn.split()):
        log.info("  %s", shlex.join(["python", "-m", "devrf", *first, *given]))
