"""The published profile, number by number, and when its losses change."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from devrf.errors import DevrfError
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.settings import NSFFSettings, Warmup

CONF = Path(__file__).parents[3] / "conf"

# Li et al., CVPR 2021, and the main branch of their release.
TRUNK = {"width": 256, "depth": 8, "skip": 5, "bands": 10, "direction_bands": 4}
SAMPLING = {"samples": 128, "density_noise": 1.0, "neighbours": "both", "hard_rays": 512}
WEIGHTS = {
    "color": 1, "dynamic": 1, "neighbours": 1, "chained": 1, "cycle": 1.0,
    "small_flow": 0.1, "smooth_space": 0.1, "smooth_time": 0.1, "depth": 0.04, "flow": 0.02,
    "disocclusion": 0.1, "blend_entropy": 1e-3,
}  # fmt: skip
WARMUP = {"steps_per_frame": 1000, "max_frames": 250, "chained_from": 2, "prior_decay": 10}


def profile(*names: str) -> Any:
    """The method's config, with those of some profiles over it."""
    sizes: Any = OmegaConf.load(CONF / "rows/method/profile.yaml")
    rows = [sizes[f"nsff_{name}"] for name in names]
    return OmegaConf.merge(OmegaConf.load(CONF / "method/nsff.yaml"), *rows).ray_stage


@pytest.mark.parametrize(
    ("place", "published"),
    [
        ("model.settings", TRUNK | SAMPLING | {"blend": "v", "sampling": "stratified"}),
        ("model.settings.warmup", WARMUP),
        ("loss", WEIGHTS),
        ("schedule", {"iterations": 360_000, "rays": 1024, "learning_rate": 5e-4}),
        ("schedule", {"betas": [0.9, 0.999], "curriculum": 0}),
    ],
)
def test_the_profile_has_the_published_numbers(place: str, published: dict[str, Any]) -> None:
    found = OmegaConf.select(profile(), place)
    for name, value in published.items():
        assert found[name] == value, name


def test_the_rate_falls_tenfold_in_300_000_iterations() -> None:
    schedule = profile().schedule
    expected = 5e-4 * 0.1 ** (schedule.iterations / 300_000)
    assert schedule.final_learning_rate == pytest.approx(expected, rel=1e-3)


def test_every_term_has_a_weight_and_every_weight_a_term() -> None:
    assert set(profile().loss) == set(NSFF.losses)


def test_defaults_in_code_are_those_of_the_config() -> None:
    settings = OmegaConf.to_container(profile().model.settings)
    assert isinstance(settings, dict)
    warmup = settings.pop("warmup")
    for given in (settings, warmup):
        given.pop("_target_")
    assert NSFFSettings(**settings, warmup=Warmup(**warmup)) == NSFFSettings()


def test_the_small_profile_looks_at_one_neighbour_and_no_further() -> None:
    small = profile("small")
    settings = small.model.settings
    assert (settings.width, settings.depth, settings.neighbours) == (64, 4, "one")
    # As many rays as in 1000 to 1500 iterations of 1024.
    rays = small.schedule.iterations * small.schedule.rays
    assert small.loss.chained == 0 and 1000 * 1024 <= rays <= 1500 * 1024


def test_the_fast_profile_chains_in_its_last_half() -> None:
    fast = profile("fast")
    settings, warmup = (
        fast.model.settings,
        Warmup(**{k: v for k, v in fast.model.settings.warmup.items() if k != "_target_"}),
    )
    assert (settings.width, settings.depth, settings.steps) == (256, 8, 128)
    assert (fast.schedule.iterations, settings.precision) == (60_000, "auto")
    for frames in (12, 50, 300):
        assert warmup.chained_from * warmup.steps(frames) == 30_000


@pytest.mark.parametrize(("frames", "steps"), [(12, 30_000), (50, 50_000), (400, 250_000)])
def test_the_beginning_grows_with_the_frames_within_limits(frames: int, steps: int) -> None:
    assert Warmup().steps(frames) == steps


def test_priors_fall_tenfold_after_each_beginning() -> None:
    warmup = Warmup(steps_per_frame=10, min_frames=1)
    factors = [warmup.prior_factor(step, frames=5) for step in (0, 49, 50, 99, 100)]
    assert factors == pytest.approx([1, 1, 0.1, 0.1, 0.01])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: NSFFSettings(width=1), "settings.width: expected at least 2, not 1"),
        (lambda: NSFFSettings(hard_rays=-1), "settings.hard_rays: expected 0 or more, not -1"),
        (lambda: NSFFSettings(flow_reach=0.0), "settings.flow_reach: expected more than 0"),
        (lambda: Warmup(steps_per_frame=0), "warmup.steps_per_frame: expected at least 1, not 0"),
        (lambda: Warmup(min_frames=300), r"warmup.min_frames: expected 1 … max_frames \(250"),
        (lambda: Warmup(prior_decay=0.5), "warmup.prior_decay: expected at least 1, not 0.5"),
    ],
)
def test_what_cannot_be_is_named(make: Any, said: str) -> None:
    with pytest.raises(DevrfError, match=said):
        make()
