"""The step that downloads a public scene: ``stage=fetch``."""

from __future__ import annotations

import logging
import shlex
from pathlib import Path

from hydra.utils import instantiate
from rich.console import Console
from rich.filesize import decimal
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn

from devrf.cli.context import RunContext
from devrf.scenes.fetch.catalogue import PublishedScene, published_scene
from devrf.scenes.fetch.fetch import RECORD, Fetched, download_size, fetch_scene, fetched_before
from devrf.scenes.fetch.settings import FetchSettings

log = logging.getLogger(__name__)


def fetch(run: RunContext) -> None:
    """Download the scene ``scene=…`` into ``fetch.into``, and say what to do with it."""
    settings: FetchSettings = instantiate(run.config.fetch)
    scene = published_scene(run.config.scene, settings.catalogue)
    into = Path(settings.into).expanduser()
    there = fetched_before(scene, into)
    _conclude(scene, there or _fetch(scene, into, settings.sha256))


def _fetch(scene: PublishedScene, into: Path, sha256: str | None) -> Fetched:
    size = download_size(scene)
    log.info(
        "%s: %s; %s from %s; licence: %s",
        scene.name,
        scene.about,
        "size unknown" if size is None else decimal(size),
        scene.collection.page,
        scene.collection.licence,
    )
    columns = (BarColumn(), DownloadColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(scene.name, total=size)
        return fetch_scene(scene, into, sha256, size, lambda done: bar.update(task, completed=done))


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
