"""Trackers: loggers that take pictures, videos and tables beside curves."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast, runtime_checkable

from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from tabulate import tabulate
from torch import Tensor

from devrf.errors import DevrfError
from devrf.pictures.images import to_bytes

if TYPE_CHECKING:
    from wandb.sdk.wandb_run import Run

Row = Mapping[str, str | float | None]


@runtime_checkable
class Tracker(Protocol):
    """A logger that also shows pictures, videos and tables, of one run across its stages."""

    def log_hyperparams(self, params: dict[str, Any]) -> None:
        """Keep the run's composed config."""

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
        super().__init__(save_dir=save_dir, name=name, version="", default_hp_metric=False)

    def log_hyperparams(self, params: dict[str, Any], *args: Any, **kwargs: Any) -> None:  # type: ignore[override]
        """Log the config as text, too: TensorBoard's own table of settings needs metrics."""
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
        """Log each number once."""
        for name, value in values.items():
            self.experiment.add_scalar(name, value, 0)

    def close(self, *, failed: bool) -> None:
        """Write out the rows that are still in memory."""
        if self._experiment is not None:
            self._experiment.close()


# Values of WANDB_MODE with which nothing leaves the machine.
OFFLINE = ("offline", "dryrun", "disabled")
# The longest name that wandb takes.
LONGEST_NAME = 128


class WandbTracker(WandbLogger):
    """One wandb run for all stages of a devrf run, found again by the id kept in its folder.

    Nothing leaves the machine offline: neither the run nor wandb's own telemetry.
    """

    def __init__(
        self,
        save_dir: str | Path,
        project: str = "devrf",
        name: str | None = None,
        group: str | None = None,
        tags: Sequence[str] = (),
        entity: str | None = None,
        offline: bool = True,
    ) -> None:
        """Name the run; it begins when something is logged first.

        wandb works in ``wandb/`` below the run's folder. ``name`` is by default that of the folder,
        ``group`` of the one that it lies in: the scene's, or the sweep's of which it is a job.
        ``entity`` None is the account that is logged in. ``wandb sync`` sends an offline run later.
        ``WANDB_MODE`` in the environment takes precedence over ``offline``.
        """
        mode = os.environ.get("WANDB_MODE")
        folder = Path(save_dir).resolve()
        if offline if not mode else mode in OFFLINE:
            # Read when wandb is first imported. It reports on itself even when offline.
            os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        super().__init__(
            name=(name or folder.name)[:LONGEST_NAME],
            save_dir=save_dir,
            project=project,
            group=(group or folder.parent.name)[:LONGEST_NAME],
            tags=list(tags),
            entity=entity,
            # Not as Lightning's `offline`, which changes WANDB_MODE.
            mode=None if mode else "offline" if offline else "online",
        )
        # wandb ignores it and warns where it is given.
        self._wandb_init.pop("anonymous", None)
        self._id_file = Path(save_dir) / "wandb" / "run_id"
        if self._id_file.is_file():
            self._id = self._wandb_init["id"] = self._id_file.read_text().strip()

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
                f"logger: wandb cannot begin a run ({error}); leave logger.offline=true, or log "
                "in with `wandb login`"
            ) from None
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
        if self._experiment is not None:
            self.experiment.finish(exit_code=int(failed))
            self._experiment = None
