"""Which settings decide what is learned, and by which key they are named."""

from __future__ import annotations

import pytest

from devrf.cli.resume import deciding_settings

STOPPING = "lightning.pytorch.callbacks.EarlyStopping"
LOOKING = "lightning.pytorch.callbacks.DeviceStatsMonitor"
TIMER = "lightning.pytorch.callbacks.Timer"


def test_the_settings_that_decide_are_named_as_the_user_sets_them(composed):
    config = composed("data=inward", "data.root=/somewhere")
    canonical = deciding_settings(config, "canonical")
    assert canonical["schedule.canonical.iterations"] == config.schedule.canonical.iterations
    assert canonical["field.width"] == 64 and canonical["loss.search.render"] == 1.0
    assert canonical["seed"] == 0 and canonical["data.box"] is None
    moving = deciding_settings(config, "deformation")
    assert moving["loss.deformation.flow"] == 0.005
    assert moving["schedule.extensions.tracks.init_from"] == "flow"
    for settings in (canonical, moving):
        words = ("root", "flow_cache", "trainer", "logger", "video", "evaluation", "callbacks")
        assert not [key for key in settings for word in words if word in key]
    assert not set(moving) & {"field.width", "schedule.canonical.iterations"}


@pytest.mark.parametrize(
    ("typed", "recorded"),
    [
        ([], {}),
        (
            ["callbacks.learning_rate_decay._target_=ramp.RampedDecay"],
            {"learning_rate_decay._target_": "ramp.RampedDecay"},
        ),
        (
            [f"+callbacks.es={{_target_: {STOPPING}, patience: 1}}"],
            {"es._target_": STOPPING, "es.patience": 1},
        ),
        # Where it writes is each run's own.
        (
            ["+callbacks.mine={_target_: mine.Watcher, folder: '${output_dir}'}"],
            {"mine._target_": "mine.Watcher", "mine.folder": "${output_dir}"},
        ),
        (["callbacks.progress._target_=mine.Meter"], {"progress._target_": "mine.Meter"}),
        (["callbacks.grid_upscaling=null"], {"grid_upscaling": None}),
        (
            ["callbacks.divergence_guard.rate_factor=0.1"],
            {"divergence_guard.rate_factor": 0.1},
        ),
        (["~callbacks"], {"time_budget": None, "divergence_guard": None}),
        # What only looks, or sets a limit.
        (["~callbacks.training_curve", "callbacks.meter=null", "callbacks.previews.times=2"], {}),
        ([f"+callbacks.mine._target_={LOOKING}", "callbacks.checkpoint.every_seconds=0"], {}),
        ([f"+callbacks.timer={{_target_: {TIMER}, duration: '00:00:00:09'}}"], {}),
        (["+callbacks.mine=null"], {}),
    ],
)
def test_callbacks_that_decide_are_settings_where_they_are_not_the_usual_ones(
    composed, typed, recorded
):
    settings = deciding_settings(composed(*typed), "canonical")
    found = {key: value for key, value in settings.items() if key.startswith("callbacks")}
    assert found == {f"callbacks.{key}": value for key, value in recorded.items()}
