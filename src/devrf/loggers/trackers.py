"""Trackers: loggers that take pictures, videos and tables beside curves."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, cast, runtime_checkable

from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from tabulate import tabulate
from torch import Tensor

from devrf.errors import DevrfError, did_you_mean
from devrf.pictures.images import to_bytes
from devrf.system.files import read_record

if TYPE_CHECKING:
    from wandb.sdk.wandb_run import Run

Row = Mapping[str, str | float | None]


@runtime_checkable
class Tracker(Protocol):
    """A logger that also shows pictures, videos and tables, of one run across its stages."""

    def show_image(self, name: str, image: Tensor, step: int | None = None) -> None:
        """Show an image (H, W, 3), in [0, 1] or uint8, as of a stage's iteration ``step``."""

    def show_video(self, name: str, path: Path) -> None:
        """Show a video file, where that is possible."""

    def show_table(self, name: str, rows: Sequence[Row]) -> None:
        """Show a table whose columns are the rows' keys, of which there is at least one."""

    def conclude(self, values: Mapping[str, float]) -> None:
        """Record the run's final numbers."""

    def close(self, *, failed: bool) -> None:
        """End the tracking, if it began."""


def trackers(loggers: Iterable[Logger]) -> list[Tracker]:
    """The loggers that are trackers."""
    return [logger for logger in loggers if isinstance(logger, Tracker)]


class TensorBoardTracker(TensorBoardLogger):
    """One set of event files for all stages of a devrf run, added to by each."""

    def __init__(self, save_dir: str | Path, name: str = "tensorboard") -> None:
        """Choose a folder in the run's; the first file is written when something is logged."""
        import_module("tensorboard")  # or Lightning would ask for another package, too
        super().__init__(save_dir=save_dir, name=name, version="", default_hp_metric=False)

    def log_hyperparams(self, params: dict[str, Any], *args: Any, **kwargs: Any) -> None:  # type: ignore[override]
        """Log the config as text; the table HPARAMS has it beside the final numbers."""
        super().log_hyperparams(params, *args, **kwargs)
        if params:
            self.experiment.add_text("config", f"```json\n{json.dumps(params, indent=2)}\n```")

    def show_image(self, name: str, image: Tensor, step: int | None = None) -> None:
        """Log an image (H, W, 3), in [0, 1] or uint8."""
        pixels = to_bytes(image).cpu().numpy()
        self.experiment.add_image(name, pixels, step or 0, dataformats="HWC")

    def show_video(self, name: str, path: Path) -> None:
        """Name the file: TensorBoard plays no mp4."""
        self.experiment.add_text(name, f"`{path}`")

    def show_table(self, name: str, rows: Sequence[Row]) -> None:
        """Log a table as Markdown."""
        table = tabulate(rows, headers="keys", tablefmt="github", floatfmt=".6g")
        self.experiment.add_text(name, table)

    def conclude(self, values: Mapping[str, float]) -> None:
        """Log each number once, in the table HPARAMS beside the config, too."""
        super().log_hyperparams(self.hparams, dict(values), step=0)

    def close(self, *, failed: bool) -> None:
        """Write out the rows that are still in memory."""
        if self._experiment is not None:
            self._experiment.close()


# Values of WANDB_MODE with which nothing leaves the machine.
OFFLINE = ("offline", "dryrun", "disabled")
# The longest name that wandb takes.
LONGEST_NAME = 128
# Set by `wandb agent` for the runs that it starts.
SWEEP = "WANDB_SWEEP_ID"


class WandbTracker(WandbLogger):
    """One wandb run for all stages of a devrf run, found again by the id kept in its folder.

    Nothing leaves the machine offline: neither the run nor wandb's own telemetry.
    """

    def __init__(
        self,
        save_dir: str | Path,
        *,
        offline: bool = True,
        log_model: bool | Literal["all"] = False,
        project: str | None = None,
        name: str | None = None,
        group: str | None = None,
        tags: Sequence[str | None] = (),
        id: str | None = None,
        resume: bool | Literal["allow", "must", "never", "auto"] | None = None,
        dir: str | Path | None = None,
        **init: Any,
    ) -> None:
        """Name the run; it begins when something is logged first.

        Each None is left to wandb's variable in the environment, else it is: the project
        ``devrf``; the name of the run's folder ``save_dir``, and as group of the one that it lies
        in, the scene's or the sweep's; the id kept in the folder; ``allow``; the folder itself,
        for ``wandb/``. ``WANDB_MODE`` takes precedence over ``offline``; a trial of ``wandb agent``
        is sent without it. ``WANDB_TAGS`` come beside ``tags``. ``log_model`` keeps the checkpoints
        of a run that ended well as an artifact. ``init`` is whatever else ``wandb.init`` takes.

        Raises:
            DevrfError: it takes no such argument.
        """
        self._folder = Path(save_dir).resolve()
        self._id_file = self._folder / "wandb" / "run_id"
        kept = None
        if self._id_file.is_file():
            try:
                kept = read_record(self._id_file, LONGEST_NAME + 1).decode().strip()
            except ValueError:
                raise DevrfError(f"{self._id_file}: no run's id; remove it") from None
        mode = "offline" if offline and SWEEP not in os.environ else "online"
        settings = init | {
            key: value if value is not None or os.environ.get(variable) else usual
            for key, value, variable, usual in (
                ("project", project, "WANDB_PROJECT", "devrf"),
                ("name", name, "WANDB_NAME", self._folder.name[:LONGEST_NAME]),
                ("group", group, "WANDB_RUN_GROUP", self._folder.parent.name[:LONGEST_NAME]),
                ("id", id, "WANDB_RUN_ID", kept),
                ("resume", resume, "WANDB_RESUME", "allow"),
                ("dir", dir, "WANDB_DIR", self._folder),
                # Not as Lightning's `offline`, which changes WANDB_MODE.
                ("mode", init.get("mode"), "WANDB_MODE", mode),
            )
        }
        labels = [*tags, *os.environ.get("WANDB_TAGS", "").split(",")]
        settings["tags"] = list(dict.fromkeys(filter(None, labels)))
        if (settings["mode"] or os.environ["WANDB_MODE"]) in OFFLINE:
            # Read when wandb is first imported. It reports on itself even when offline.
            os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        import wandb

        known = {*signature(wandb.init).parameters, *signature(WandbLogger.__init__).parameters}
        for key in settings.keys() - known:
            meant = did_you_mean(key, known, "logger.wandb.")
            raise DevrfError(f"logger.wandb.{key}: wandb.init takes no such argument{meant}")
        super().__init__(save_dir=settings.pop("dir"), log_model=log_model, **settings)
        # wandb ignores it and warns where it is given.
        self._wandb_init.pop("anonymous", None)

    @property
    def experiment(self) -> Run:
        """The wandb run, begun at the first use.

        Raises:
            DevrfError: wandb could not begin it.
        """
        import wandb

        begun = self._experiment is not None
        try:
            run = cast("Run", super().experiment)
        except wandb.errors.Error as error:
            raise DevrfError(
                f"logger.wandb: wandb cannot begin a run ({error}); leave "
                "logger.wandb.offline=true, or log in with `wandb login`"
            ) from error
        except (TypeError, ValueError) as error:
            raise DevrfError(f"logger.wandb: wandb.init refuses its settings ({error})") from error
        if not begun and self._experiment is not None:
            self._id_file.parent.mkdir(exist_ok=True)
            self._id_file.write_text(f"{run.id}\n")
        return run

    def show_image(self, name: str, image: Tensor, step: int | None = None) -> None:
        """Log an image (H, W, 3), in [0, 1] or uint8."""
        self.log_image(name, [to_bytes(image).cpu().numpy()], step)

    def show_video(self, name: str, path: Path) -> None:
        """Log a video file as it is."""
        self.log_video(name, [str(path)], format=[path.suffix[1:]])

    def show_table(self, name: str, rows: Sequence[Row]) -> None:
        """Log a table."""
        names = list(dict.fromkeys(key for row in rows for key in row))
        self.log_table(name, names, [[row.get(key) for key in names] for row in rows])

    def conclude(self, values: Mapping[str, float]) -> None:
        """Put numbers into the run's summary."""
        self.experiment.summary.update(dict(values))

    def close(self, *, failed: bool) -> None:
        """Finish the run, so that the next job of a sweep begins its own."""
        if self._experiment is None:
            return
        files = sorted((self._folder / "checkpoints").glob("*.ckpt"))
        if self._log_model and files and not failed:
            from wandb import Artifact

            artifact = Artifact(self._checkpoint_name or f"model-{self.experiment.id}", "model")
            for path in files:
                artifact.add_file(str(path))
            self.experiment.log_artifact(artifact)
        self.experiment.finish(exit_code=int(failed))
        self._experiment = None
