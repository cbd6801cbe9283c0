"""The callbacks that only watch: curves and previews change nothing, and cost what they say."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import pytest
import torch
from lightning import Callback, Trainer
from lightning.pytorch.loggers import Logger
from torch import Tensor

from devrf.callbacks import Meter, Previews, TrainingCurve
from devrf.data.datamodule import SceneDataModule
from devrf.loggers.trackers import Row
from devrf.methods.devrf.canonical_stage import CanonicalStage


class Album(Logger):
    """A tracker that keeps what it is shown."""

    def __init__(self) -> None:
        super().__init__()
        self.images: dict[str, list[tuple[int | None, Tensor]]] = {}
        self.rows: list[dict[str, float]] = []

    name = "album"
    version = 0

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        self.rows.append({**metrics, "step": float(step or 0)})

    def log_hyperparams(self, params: dict[str, Any]) -> None: ...  # type: ignore[override]

    def show_image(self, name: str, image: Tensor, step: int | None = None) -> None:
        self.images.setdefault(name, []).append((step, image))

    def show_video(self, name: str, path: Path) -> None: ...

    def show_table(self, name: str, rows: Sequence[Row]) -> None: ...

    def conclude(self, values: Mapping[str, float]) -> None: ...

    def close(self, *, failed: bool) -> None: ...


@pytest.fixture
def learn(
    canonical, datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> Callable[..., CanonicalStage]:
    """``learn(logger, *callbacks)``: a stage of 12 iterations, with a row of curves every 4."""

    def fit(logger: Logger, *callbacks: Callback) -> CanonicalStage:
        torch.manual_seed(3)
        stage: CanonicalStage = canonical()
        made = trainer(*callbacks, max_epochs=1, log_every_n_steps=4, limit_val_batches=1)
        made.loggers = [logger]
        made.fit(stage, datamodule=datamodule)
        return stage

    return fit


def test_previews_come_as_often_as_asked_for_and_look_right(learn, datamodule):
    album = Album()
    learn(album, Previews(times=3))
    shown = album.images["static/view"]
    assert [step for step, _ in shown] == [4, 8, 12]
    views = datamodule.scene.static.test
    (_, strip), (_, depth) = shown[-1], album.images["static/depth"][-1]
    # Prediction, truth and error, four pixels apart.
    assert strip.shape == (views.height, 3 * views.width + 8, 3)
    assert depth.shape == (views.height, views.width, 3)
    truth = strip[:, views.width + 4 : 2 * views.width + 4]
    pixels = views.pixels[len(views) // 2].float() / 255
    expected = 1 + pixels[..., 3:] * (pixels[..., :3] - 1)  # on white
    torch.testing.assert_close(truth, expected)


def test_the_curve_of_a_stage_has_every_step(learn, tmp_path, monkeypatch):
    drawn: list[Any] = []
    module = "devrf.callbacks.training_curve"
    original = importlib.import_module(module).write_training_curve
    monkeypatch.setattr(
        f"{module}.write_training_curve", lambda *a: drawn.append(a[1:]) or original(*a)
    )
    album = Album()
    learn(album, Meter(), Previews(times=3), TrainingCurve(tmp_path / "images"))
    ((stage, batches, previews, grids, frames),) = drawn
    assert frames == []  # all times at once
    assert stage == "canonical" and [iteration for iteration, _ in batches] == list(range(1, 13))
    logged = {row["step"]: row["static/psnr"] for row in album.rows if "static/psnr" in row}
    assert {k: psnr for k, psnr in batches if k in logged} == pytest.approx(logged)
    assert [iteration for iteration, _ in previews] == [4, 8, 12]
    assert [iteration for iteration, _ in grids] == [1, 4, 8]  # the schedule's upsample_at: 3, 7
    height, width, _ = iio.imread(tmp_path / "images" / "training_canonical.png").shape
    assert height > 400 and width > 800


def test_a_curve_goes_on_after_a_break_and_a_rollback(learn, tmp_path):
    class Keeping(TrainingCurve):
        def on_fit_end(self, trainer: Trainer, pl_module: Any) -> None: ...

    first = Keeping(tmp_path)
    stage = learn(Album(), first)
    second = TrainingCurve(tmp_path)
    second.load_state_dict(first.state_dict())
    assert second.state_dict() == first.state_dict() and len(first.state_dict()["points"]) == 12
    # Iteration 12 once more, after it was rolled back to 10.
    for iteration in (11, 12):
        stage.position.iterations_done = iteration
        error = {"psnr": torch.tensor(10.0 * iteration)}
        second.on_train_batch_end(stage.trainer, stage, error, None, 0)
    points = second.state_dict()["points"]
    assert [iteration for iteration, _ in points] == list(range(1, 13))
    assert points[-2:] == [(11, pytest.approx(110)), (12, pytest.approx(120))]


def test_watching_changes_nothing_of_what_is_learned_and_curves_stand_beside_the_losses(learn):
    album = Album()
    stage = learn(album, Meter(), Previews(times=4))
    watched, alone = stage.scene_model.canonical, learn(Album()).scene_model.canonical
    assert torch.equal(watched.density.values, alone.density.values)
    assert torch.equal(watched.color.values, alone.color.values)
    x, y, z = stage.scene_model.resolution
    rows = [row for row in album.rows if "static/psnr" in row]
    assert [row["step"] for row in rows] == [4, 8, 12]
    for row in rows:
        assert row["static/psnr"] == pytest.approx(-10 * math.log10(row["static/render"]), abs=1e-4)
        assert row["static/loss"] > 0 and row["static/iterations_per_second"] > 0
        factor = stage.schedule.learning_rate_factor(row["step"] - 1)
        assert row["static/lr/density"] == pytest.approx(0.1 * factor)
    assert rows[-1]["static/voxels"] == x * y * z
