"""Rows of the table in docs/python.md#lightning: known parts of Lightning work, or are refused."""

from __future__ import annotations

import copy
import logging

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.callbacks import (
    DeviceStatsMonitor,
    EarlyStopping,
    LearningRateMonitor,
    ModelCheckpoint,
)
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from devrf.callbacks import GridUpscaling, LearningRateDecay, Previews
from devrf.checkpoints.checkpoint import load_checkpoint
from devrf.checkpoints.checkpoint_file import read_checkpoint_file
from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage


def test_terms_and_psnr_are_in_callback_metrics(fit, canonical):
    metrics = fit(canonical(), every=1).trainer.callback_metrics
    names = {"static/loss", "static/render", "static/per_sample_color", "static/psnr"}
    assert names <= set(metrics)
    expected = -10 * torch.log10(metrics["static/render"])
    torch.testing.assert_close(metrics["static/psnr"], expected)


def test_rows_of_loggers_are_by_iterations(canonical, datamodule, trainer, tmp_path):
    loggers = [CSVLogger(tmp_path, "one"), CSVLogger(tmp_path, "two")]
    fitted = trainer(max_epochs=1, log_every_n_steps=1, logger=loggers)
    fitted.fit(canonical(iterations_per_step=2), datamodule=datamodule)
    for name in ("one", "two"):
        table = (tmp_path / name / "version_0" / "metrics.csv").read_text().splitlines()
        column = table[0].split(",").index("step")
        # Grids grow after iterations 3 and 7, where a step ends, too.
        assert [int(row.split(",")[column]) for row in table[1:]] == [2, 3, 5, 7, 9, 11, 12]


def test_early_stopping_ends_a_stage_which_then_counts_as_complete(
    canonical, datamodule, trainer, caplog, tmp_path
):
    caplog.set_level(logging.INFO, logger="devrf")
    stopping = EarlyStopping("val/psnr", mode="max", patience=1, min_delta=1000.0)
    fitted = trainer(Previews(times=12), stopping, max_epochs=1, limit_val_batches=1)
    stage = canonical()
    fitted.fit(stage, datamodule=datamodule)
    assert stage.is_complete and stage.position.iteration == 2
    assert "canonical: EarlyStopping has ended it at iteration 2 of 12" in caplog.text
    assert stage.result().metadata.complete


def test_early_stopping_before_the_last_kind_of_phase_is_no_result(canonical, datamodule, trainer):
    stopping = EarlyStopping("val/psnr", mode="max", patience=1, min_delta=1000.0)
    fitted = trainer(Previews(times=12), stopping, max_epochs=1, limit_val_batches=1)
    stage = canonical(search_iterations=6)
    with pytest.raises(DevrfError, match="iteration 3 of 18 .*, before fine; more patience"):
        fitted.fit(stage, datamodule=datamodule)
    assert not stage.is_complete


def test_model_checkpoint_keeps_the_best(canonical, datamodule, trainer, tmp_path):
    keeping = ModelCheckpoint(tmp_path, filename="best", monitor="val/psnr", mode="max")
    fitted = trainer(
        Previews(times=6), keeping, max_epochs=1, limit_val_batches=1, enable_checkpointing=True
    )
    stage = canonical(rays=512)
    fitted.fit(stage, datamodule=datamodule)
    best = float(keeping.best_model_score)
    assert best == pytest.approx(max(p for _, p in fitted.callbacks[2].psnr), abs=1e-4)
    loaded = load_checkpoint(tmp_path / "best.ckpt", stage.scene)
    assert loaded.metadata.stage == "canonical"


@pytest.mark.parametrize("moving", [False, True])
def test_a_stage_that_is_over_is_saved_and_goes_on_nowhere(
    canonical, rest, datamodule, trainer, tmp_path, moving
):
    def build():
        if not moving:
            return canonical()
        levels = DeformationSchedule(levels=(Level(4, 2),), rays=64)
        return DeformationStage(copy.deepcopy(rest), levels, iterations_per_step=1)

    stage, fitted = build(), trainer(max_epochs=1)
    fitted.fit(stage, datamodule=datamodule)
    fitted.save_checkpoint(tmp_path / "over.ckpt")
    again = build()
    trainer(max_epochs=1).fit(again, datamodule=datamodule, ckpt_path=tmp_path / "over.ckpt")
    assert again.is_complete
    learned = {name: v for name, v in stage.state_dict().items() if isinstance(v, torch.Tensor)}
    for name, value in learned.items():
        assert torch.equal(again.state_dict()[name], value), name


def test_learning_rates_are_monitored(canonical, datamodule, trainer, tmp_path):
    logger = CSVLogger(tmp_path, "rates")
    monitor = LearningRateMonitor(logging_interval="step")
    fitted = trainer(monitor, max_epochs=1, log_every_n_steps=1, logger=logger)
    fitted.fit(canonical(), datamodule=datamodule)
    assert "lr-GridAdam/density" in fitted.callback_metrics


def test_the_simple_profiler_prints(canonical, datamodule, trainer, tmp_path):
    from lightning.pytorch.profilers import SimpleProfiler

    profiler = SimpleProfiler(tmp_path, "profile")
    trainer(max_epochs=1, profiler=profiler).fit(canonical(), datamodule=datamodule)
    assert "run_training_batch" in (tmp_path / "fit-profile.txt").read_text()


def test_a_stage_is_validated_and_tested(learned, rest, datamodule, trainer, tiny_scene):
    stage, _ = learned
    validated = trainer(limit_val_batches=2).validate(stage, datamodule=datamodule, verbose=False)
    assert set(validated[0]) >= {"val/psnr", "val/ssim"}
    (tested,) = trainer().test(stage, datamodule=datamodule, verbose=False)
    assert tested["test/static/psnr"] > 10
    moving = DeformationStage(rest)
    (tested,) = trainer().test(moving, datamodule=datamodule, verbose=False)
    assert tested["test/dynamic/psnr"] == pytest.approx(
        tested["test/dynamic/rest_pose_psnr"], abs=1e-3
    )


def test_a_checkpoint_is_no_stage(tmp_path):
    with pytest.raises(DevrfError, match=r"CanonicalStage.load_from_checkpoint: .*load_checkpoint"):
        CanonicalStage.load_from_checkpoint(tmp_path / "any.ckpt")


def test_tensorboard_takes_the_same_rows(canonical, datamodule, trainer, tmp_path):
    pytest.importorskip("tensorboard")
    logger = TensorBoardLogger(tmp_path)
    fitted = trainer(max_epochs=1, log_every_n_steps=1, logger=logger)
    fitted.fit(canonical(), datamodule=datamodule)
    assert list(tmp_path.rglob("events.*"))


@pytest.mark.parametrize("option", [{"gradient_clip_val": 1.0}, {"accumulate_grad_batches": 2}])
def test_steps_that_are_not_the_stages_own_are_refused(canonical, datamodule, trainer, option):
    with pytest.raises(MisconfigurationException, match="manual optimization"):
        trainer(max_epochs=1, **option).fit(canonical(), datamodule=datamodule)


def test_a_limit_of_time_ends_a_stage_before_its_schedule(canonical, datamodule, trainer):
    stage = canonical()
    trainer(max_time={"seconds": 0}).fit(stage, datamodule=datamodule)
    assert stage.position.iteration == 0 and not stage.is_complete


def test_the_devices_figures_are_logged(canonical, datamodule, trainer, tmp_path):
    logger = CSVLogger(tmp_path, "stats")
    fitted = trainer(DeviceStatsMonitor(), max_epochs=1, log_every_n_steps=1, logger=logger)
    fitted.fit(canonical(), datamodule=datamodule)
    table = (tmp_path / "stats" / "version_0" / "metrics.csv").read_text()
    assert "DeviceStatsMonitor.on_train_batch_end" in table


def test_a_fit_without_a_datamodule_is_refused(canonical, trainer):
    with pytest.raises(DevrfError, match="CanonicalStage: it learns from .* give datamodule="):
        trainer(max_epochs=1).fit(canonical(), [0])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_fit_that_ended_early_leaves_the_state_of_a_gpus_random_numbers(
    canonical, datamodule, tmp_path
):
    callbacks = [GridUpscaling(), LearningRateDecay()]
    quiet = {"logger": False, "enable_checkpointing": False, "limit_val_batches": 0}
    fitted = Trainer(accelerator="gpu", devices=1, max_steps=2, callbacks=callbacks, **quiet)
    fitted.fit(canonical(), datamodule=datamodule)
    fitted.save_checkpoint(tmp_path / "left.ckpt")  # the stage has been moved to the host
    assert "cuda" in read_checkpoint_file(tmp_path / "left.ckpt")["progress"]["random"]


@pytest.mark.parametrize("key", ["min_steps", "min_epochs"])
def test_a_fit_that_would_never_end_is_refused(canonical, datamodule, trainer, key):
    with pytest.raises(DevrfError, match=f"trainer.{key}: expected none: the schedule says"):
        trainer(max_epochs=1, max_time="00:00:00:05", **{key: 100}).fit(
            canonical(), datamodule=datamodule
        )
