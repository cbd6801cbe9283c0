"""TensorBoard: the only place that knows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from devrf.apps.colors import to_bytes
from devrf.apps.tracking import Row, columns


class TensorBoardTracker(TensorBoardLogger):
    """One set of event files for all stages of a devrf run, added to by each."""

    def __init__(self, save_dir: str | Path, name: str = "tensorboard") -> None:
        """Choose the folder; the first file is written when something is logged.

        Args:
            save_dir: the run's folder.
            name: the folder in it.
        """
        super().__init__(save_dir=save_dir, name=name, version="", default_hp_metric=False)

    def show_image(self, name: str, image: Tensor, step: int | None = None) -> None:
        """Log an image (H, W, 3) in [0, 1]."""
        pixels = to_bytes(image).cpu().numpy()
        self.experiment.add_image(name, pixels, step or 0, dataformats="HWC")

    def show_video(self, name: str, path: Path) -> None:
        """Name the file: TensorBoard plays no mp4."""
        self.experiment.add_text(name, f"`{path}`")

    def show_table(self, name: str, rows: Sequence[Row]) -> None:
        """Log a table as Markdown."""
        names = columns(rows)
        cells = [names, ["---"] * len(names), *([_cell(row.get(k)) for k in names] for row in rows)]
        self.experiment.add_text(name, "\n".join(f"| {' | '.join(line)} |" for line in cells))

    def conclude(self, values: Mapping[str, float]) -> None:
        """Log each number once."""
        for name, value in values.items():
            self.experiment.add_scalar(name, value, 0)

    def close(self, *, failed: bool) -> None:
        """Write out what is still in memory."""
        if self._experiment is not None:
            self._experiment.close()


def _cell(value: str | float | None) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
