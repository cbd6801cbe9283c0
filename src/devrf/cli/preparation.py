"""Steps before learning: a scene is fetched, captured, written, inspected; the GPU is checked."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import get_args

from hydra import compose
from hydra.utils import instantiate

from devrf.apps.capture.pipeline import scene_from_footage
from devrf.apps.fetch import FetchSettings, fetched, published_scene
from devrf.apps.inspection.advice import Advice, image_sets
from devrf.apps.inspection.report import inspection_text, show
from devrf.apps.settings import CaptureSettings
from devrf.cli.complete import completed
from devrf.cli.config import command_line
from devrf.cli.context import RunContext
from devrf.cli.memory import forecast, table_of_needs
from devrf.cli.sweep import compare_runs
from devrf.data.rendered import ProceduralDataModule
from devrf.engine.ddp import ManualDDP
from devrf.engine.needs import SIZE
from devrf.errors import DevrfError
from devrf.scenes.exchange import Exchange, PrepareSettings, write_for_others
from devrf.scenes.export import export
from devrf.system.files import write_json
from devrf.system.override import literal, to_type

log = logging.getLogger(__name__)


def say_next(*commands: list[str]) -> None:
    """Log commands that go on from here."""
    log.info("next:")
    for words in commands:
        log.info("  %s", command_line(*words))


def fetch(run: RunContext) -> None:
    """Download the scene ``scene=…`` into ``fetch.into``, and say the next commands."""
    settings: FetchSettings = instantiate(run.config.fetch)
    scene = published_scene(run.config.scene, settings.catalogue)
    root = to_type("data.root", fetched(scene, settings, progress=sys.stderr.isatty()))
    say_next(["stage=inspect", root], [*scene.collection.learn.split(), root])


def capture(run: RunContext) -> None:
    """Make a scene of the footage ``capture.…``, and report on it as ``stage=inspect`` does."""
    settings: CaptureSettings = instantiate(run.config.capture, _convert_="all")
    folder = scene_from_footage(settings)
    phone = "experiment=phone_gpu" if run.device.type == "cuda" else "experiment=phone"
    how = [phone] if settings.monocular else []
    applied = completed([f"data.root={literal(folder)}", "stage=inspect"])
    for line in applied.remarks:
        log.info("%s", line)
    config = compose("config", [*applied.words, *how])
    shortage = inspect(RunContext(config, run.folder))
    fits = [f"{SIZE}=auto"] if shortage is not None and shortage.where == SIZE else []
    say_next([to_type("data.root", folder), *how, *fits])


def prepare(run: RunContext) -> None:
    """Write the scene to ``prepare.into``, in the published layout or for other programs.

    Raises:
        DevrfError: no folder is given, or the published layout cannot have the scene.
    """
    settings: PrepareSettings = instantiate(run.config.prepare)
    if settings.into is None:
        raise DevrfError("prepare.into: stage=prepare needs a folder; give prepare.into=PATH")
    folder = Path(settings.into)
    if settings.layout != "devrf":
        write_for_others(run.scene, folder, settings.layout)
    elif isinstance(run.datamodule, ProceduralDataModule):
        export(run.scene, folder)
    else:
        others = " or ".join(f"prepare.layout={layout}" for layout in get_args(Exchange))
        raise DevrfError(f"prepare.layout: devrf is for embedded scenes; give {others}")
    log.info("scene written to %s", folder)


def inspect(run: RunContext) -> Advice | None:
    """Report and draw the scene's content, its needs and its likely mistakes.

    Returns:
        What to do where this machine has too little for the run.
    """
    # Only this step draws with matplotlib.
    from devrf.apps.inspection.picture import write_inspection_picture

    count = len({name for views in image_sets(run.scene).values() for name in views.names})
    log.info("looks at %d images: cameras, masks, times, and what a run will need", count)
    _, shortage = forecast(run, run.stages_with_images or run.learning_stages)
    show(inspection_text(run.scene, table_of_needs(run, run.scene), shortage))
    path = run.folder / "images" / "inspect.png"
    write_inspection_picture(path, run.scene)
    log.info("picture written to %s", path)
    return shortage


def report(run: RunContext) -> None:
    """The step of ``stage=report``, where the command has not compared runs before torch."""
    compare_runs(run.config)


def selfcheck(run: RunContext) -> None:
    """Make the checks on the trainer's device: a line for each, and ``selfcheck.json``.

    Raises:
        DevrfError: the trainer has several devices, or checks have failed.
    """
    if isinstance(run.strategy, ManualDDP):
        raise DevrfError("trainer: stage=selfcheck checks one device; leave out trainer=ddp")
    # It learns along flow, by an extension that may be taken out.
    from devrf.selfcheck import run_checks

    results = []
    for name, verdict, detail in run_checks(run.device, run.config.seed):
        log.info("%s  %s: %s", verdict, name, detail)
        results.append({"name": name, "verdict": verdict, "said": detail})
        # After each, so that the file is there whatever ends the run.
        write_json(run.folder / "selfcheck.json", {"checks": results})
    failed = [result["name"] for result in results if result["verdict"] == "failed"]
    if failed:
        raise DevrfError(f"stage=selfcheck: {len(failed)} checks failed: {', '.join(failed)}")
