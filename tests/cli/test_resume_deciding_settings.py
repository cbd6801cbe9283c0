"""Which settings decide what is learned, and by which key they are named."""

from __future__ import annotations

from devrf.cli.resume import deciding_settings


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
