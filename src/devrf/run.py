"""One run: its folder, its scene, and what each stage does there."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from hydra.utils import instantiate
from lightning import Trainer, seed_everything
from omegaconf import DictConfig
from rich.console import Console

from devrf.artifacts.camera_paths import focus_distance, orbit, spiral
from devrf.artifacts.contact_sheet import write_contact_sheet
from devrf.artifacts.files import write_json
from devrf.artifacts.film import FilmSettings, pictures, write_video
from devrf.artifacts.inspection import inspect_scene
from devrf.artifacts.inspection_picture import write_inspection_picture
from devrf.artifacts.inspection_text import plain, tables
from devrf.artifacts.records import mean_scores, provenance, write_frames
from devrf.callbacks import TrainingRecord
from devrf.data.datamodule import SceneDataModule
from devrf.errors import DevrfError
from devrf.losses.composer import WeightedLoss
from devrf.losses.motion import MOTION_TERMS
from devrf.scenes.export import export
from devrf.scenes.scene import CaptureName
from devrf.stages.checkpoint import Stored, load_checkpoint, save_checkpoint
from devrf.stages.evaluation import Evaluation, Judge
from devrf.stages.held_out import HeldOutView, background_value, score
from devrf.stages.memory import estimate
from devrf.stages.stage import ScheduledStage

log = logging.getLogger(__name__)

# Stages that no checkpoint is of use to.
FROM_NOTHING = ("prepare", "inspect", "canonical", "pipeline")

# What Lightning says of every run (accelerators it looked for, tips, how many workers a loader
# might have) is of no use to someone who watches a scene being learned.
for _name in ("lightning.pytorch", "lightning.fabric"):
    logging.getLogger(_name).setLevel(logging.WARNING)
for _words in (
    "does not have many workers", "LeafSpec", "GPU available but not used",
    "Experiment logs directory",
):
    warnings.filterwarnings("ignore", message=f".*{_words}.*")


class Run:
    """A configured run in a folder: ``run(stage)`` does what ``stage=…`` asks for.

    In the folder: ``checkpoints/canonical.ckpt`` and ``deformation.ckpt``, ``metrics.json``,
    ``images/`` and ``videos/``, next to the composed config and the log that Hydra writes.
    """

    def __init__(self, config: DictConfig, folder: Path) -> None:
        """Take a composed config (``conf/config.yaml``) and the folder to work in."""
        self.config = config
        self.folder = folder
        self.datamodule: SceneDataModule = instantiate(config.data)
        self._logger: Any = None

    def __call__(self, stage: str) -> None:
        """Do what ``stage`` asks for.

        Raises:
            DevrfError: an unknown stage, or whatever is wrong with the input.
        """
        stages: dict[str, list[Callable[[], None]]] = {
            "prepare": [self.prepare],
            "canonical": [self.canonical],
            "deformation": [self.deformation],
            "evaluate": [self.evaluate],
            "render": [self.render],
            "inspect": [self.inspect],
            "pipeline": [self.canonical, self.deformation, self.evaluate, self.render],
        }
        if stage not in stages:
            raise DevrfError(f"stage: expected one of {', '.join(stages)}, not {stage!r}")
        self._check(stage)
        for step in stages[stage]:
            seed_everything(self.config.seed, verbose=False)
            step()

    def _check(self, stage: str) -> None:
        """Find what can be found wrong before the first stage has cost any time.

        A mistake in the deformation's config would else show when the canonical stage is done.
        """
        if self.config.ckpt is not None and stage in FROM_NOTHING:
            raise DevrfError(
                f"ckpt: stage={stage} starts from nothing; with ckpt=PATH give stage=deformation, "
                "stage=evaluate or stage=render"
            )
        instantiate(self.config.canonical, _convert_="all")
        instantiate(self.config.deformation, _partial_=True, _convert_="all")
        weights = {k: v for k, v in self.config.deformation.loss.items() if k != "tv"}
        WeightedLoss(MOTION_TERMS, weights)
        self._evaluation().check()
        instantiate(self.config.video)

    def prepare(self) -> None:
        """Write the scene to ``data.export`` in the published layout."""
        folder = getattr(self.datamodule, "export", None)
        if folder is None:
            raise DevrfError("data.export: stage=prepare needs a folder; give data.export=PATH")
        export(self.datamodule.scene, folder)
        log.info("scene written to %s", folder)

    def inspect(self) -> None:
        """Say and draw what the scene holds and what may be wrong with it; learn nothing."""
        scene = self.datamodule.scene
        canonical = instantiate(self.config.canonical, _convert_="all")
        moving = instantiate(self.config.deformation.schedule, _convert_="all")
        budget = estimate(
            scene, canonical.schedule, moving, canonical.architecture, canonical.sampling.step
        )
        found = inspect_scene(scene)
        console = Console()
        if console.is_terminal:
            console.print(tables(found, budget))
        else:
            log.info("%s", plain(found, budget))
        path = self.folder / "images" / "inspect.png"
        write_inspection_picture(path, scene)
        log.info("picture written to %s", path)

    def canonical(self) -> None:
        """Learn the scene at rest."""
        self._fit(instantiate(self.config.canonical, _convert_="all"), "canonical")

    def deformation(self) -> None:
        """Learn how the scene moves, on top of a canonical checkpoint."""
        rest = self._load("canonical")
        if rest.model.deformation is not None:
            raise DevrfError(
                "ckpt: stage=deformation needs a canonical checkpoint, not a deformation's"
            )
        build = instantiate(self.config.deformation, _partial_=True, _convert_="all")
        self._fit(build(rest=rest), "deformation")

    def evaluate(self) -> None:
        """Score what was learned on held-out views; write metrics and contact sheets."""
        stored = self._load("deformation", "canonical")
        records = stored.passport.records
        judge = self._evaluation().judge(self._device())
        rest = self._score(stored, "static", judge)
        frames = {"static": rest}
        sections: dict[str, Any] = {
            "scene": self.datamodule.scene.name,
            "canonical": {**mean_scores(rest), **records.get("canonical", {})},
        }
        if stored.model.deformation is not None:
            moving = frames["dynamic"] = self._score(stored, "dynamic", judge)
            checkpoint = self._checkpoint("deformation")
            sections["deformation"] = {
                **mean_scores(moving),
                "rest_pose_psnr": round(mean(v.rest_pose_psnr for v in moving), 4),
                **records.get("deformation", {}),
                "checkpoint_mb": round(checkpoint.stat().st_size / 1e6, 3),
            }
        write_frames(self.folder / "frames.csv", frames)
        ran = provenance(stored.model, self._device())
        write_json(self.folder / "metrics.json", {**sections, "run": ran})
        for name, values in sections.items():
            if isinstance(values, dict):
                log.info("%s: %s", name, _line(values))

    def render(self) -> None:
        """Film the held-out view over time, and an orbit (or a spiral) while time runs."""
        stored, scene = self._load("deformation", "canonical"), self.datamodule.scene
        film: FilmSettings = instantiate(self.config.video)
        device = self._device()
        model = stored.model.to(device)
        held_out = scene.dynamic.test.cameras[[0] * film.frames]
        captured = scene.static.train.cameras
        paths = {"held_out": held_out}
        if scene.kind == "forward":
            paths["spiral"] = spiral(captured, focus_distance(model, captured, device), film)
        else:
            paths["orbit"] = orbit(captured, model.canonical.box, film)
        for name, cameras in paths.items():
            path = self.folder / "videos" / f"{name}.mp4"
            shown = pictures(model, cameras, background_value(scene.background), device)
            write_video(path, shown, film.fps)
            log.info("video written to %s", path)

    def _fit(self, stage: ScheduledStage, name: str) -> None:
        _ = self.datamodule.scene  # what is wrong with it is said before a logger writes files
        callbacks = [*instantiate(self.config.callbacks).values(), TrainingRecord()]
        trainer: Trainer = instantiate(
            self.config.trainer, callbacks=callbacks, logger=self._shared_logger(),
            default_root_dir=str(self.folder),
        )
        trainer.fit(stage, datamodule=self.datamodule)
        if trainer.interrupted:
            raise KeyboardInterrupt
        path = self._own_checkpoint(name)
        save_checkpoint(trainer, path)
        log.info("%s: %s; written to %s", name, _line(stage.record), path)

    def _shared_logger(self) -> Any:
        if self._logger is None:
            self._logger = instantiate(self.config.logger)
        return self._logger

    def _own_checkpoint(self, name: str) -> Path:
        return self.folder / "checkpoints" / f"{name}.ckpt"

    def _checkpoint(self, *names: str) -> Path:
        """The checkpoint that was asked for, else the one of ``names`` that was written last.

        A deformation that is older than the run's canonical field belongs to another.
        """
        if self.config.ckpt is not None:
            if not Path(self.config.ckpt).is_file():
                raise DevrfError(f"{self.config.ckpt}: no such checkpoint; set ckpt to a file")
            return Path(self.config.ckpt)
        found = [path for path in map(self._own_checkpoint, names) if path.exists()]
        if not found:
            raise DevrfError(
                f"{self._own_checkpoint(names[-1])}: no such checkpoint; run stage={names[-1]} "
                "first, or give ckpt=PATH"
            )
        return max(found, key=lambda path: path.stat().st_mtime)

    def _load(self, *names: str) -> Stored:
        return load_checkpoint(self._checkpoint(*names), self.datamodule.scene)

    def _device(self) -> torch.device:
        trainer: Trainer = instantiate(self.config.trainer, logger=False)
        device: torch.device = trainer.strategy.root_device
        return device

    def _evaluation(self) -> Evaluation:
        chosen: Evaluation = instantiate(self.config.evaluation, _convert_="all")
        return chosen

    def _score(self, stored: Stored, capture: CaptureName, judge: Judge) -> list[HeldOutView]:
        scene, device = self.datamodule.scene, self._device()
        views, model = scene.capture(capture).test, stored.model.to(device)
        if capture == "static":
            model = model.at_rest()
        scored = [
            score(model, views, k, scene.background, device, judge) for k in range(len(views))
        ]
        write_contact_sheet(self.folder / "images" / f"{capture}.png", scored)
        return scored


def _line(values: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items() if value is not None)
