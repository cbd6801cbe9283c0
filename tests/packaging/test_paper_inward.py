"""``experiment=paper_inward`` is the paper's schedule (supplementary, section A), to the number."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest
from hydra.utils import instantiate

from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.settings import (
    DEFORMATION_LOSS,
    FINE_LOSS,
    SEARCH_LOSS,
    CanonicalRates,
    MotionSettings,
    Sampling,
)

ROOT = "data.root=scene"


@pytest.fixture
def paper(composed):
    """The composed experiment."""
    return composed("experiment=paper_inward", ROOT)


def test_rates_and_batches(paper):
    rates, motion = instantiate(paper.schedule.rates), instantiate(paper.schedule.motion)
    assert (rates.density, rates.color, rates.decoder) == (0.1, 0.1, 1e-3)
    assert (motion.learning_rate, motion.unit) == (1e-3, "world")
    # A batch is drawn from all pixels of one view.
    assert (motion.views, motion.pixels) == ("one", "all")


def test_field_and_sampling(paper):
    field, sampling = instantiate(paper.field), instantiate(paper.sampling)
    assert (field.channels, field.width, field.frequencies) == (12, 128, 4)
    assert (field.alpha_init, field.search_alpha_init) == (1e-2, 1e-6)
    assert (sampling.step, sampling.alpha_threshold) == (0.5, 1e-4)
    assert sampling.occupancy_threshold == 1e-3


def test_loss_weights(paper):
    assert dict(paper.loss.search) == {"color": 1.0, "per_sample_color": 0.1, "entropy": 0.01}
    assert dict(paper.loss.fine) == {"color": 1.0, "per_sample_color": 0.01, "entropy": 0.001}
    assert dict(paper.loss.deformation) == {
        "render": 1.0,
        "cycle": 100.0,
        "flow": 0.005,
        "tv": 1.0,
        "per_sample_color": 0.1,
        "entropy": 0.01,
    }


def test_the_config_says_what_the_code_defaults_to(paper):
    """Plain Lightning code that states nothing gets the paper's stages too."""
    schedules = {"canonical": CanonicalSchedule(), "deformation": DeformationSchedule()}
    for key, default in schedules.items():
        found = instantiate(paper.schedule[key], _convert_="all")
        # As text, in which lists are tuples.
        assert json.dumps(asdict(found)) == json.dumps(asdict(default))
    assert instantiate(paper.field) == Architecture()
    assert instantiate(paper.sampling) == Sampling()
    assert instantiate(paper.schedule.rates) == CanonicalRates()
    # Where frames rest changes nothing that is learned: here with the least memory of a GPU.
    assert instantiate(paper.schedule.motion) == MotionSettings(store="host")
    assert dict(paper.loss.search) == SEARCH_LOSS
    assert dict(paper.loss.fine) == FINE_LOSS
    assert dict(paper.loss.deformation) == DEFORMATION_LOSS


@pytest.mark.parametrize(
    ("ablation", "off", "coarse_to_fine"),
    [
        ("base", {"tv", "cycle", "flow"}, False),
        ("c2f", {"tv", "cycle", "flow"}, True),
        ("c2f_tv", {"cycle", "flow"}, True),
        ("c2f_tv_cycle", {"flow"}, True),
        ("full", set(), True),
    ],
)
def test_the_rows_of_the_ablation_tables(composed, ablation, off, coarse_to_fine):
    config = composed("experiment=paper_inward", ROOT, f"ablation={ablation}")
    assert {name for name, weight in config.loss.deformation.items() if not weight} == off
    assert config.schedule.deformation.coarse_to_fine is coarse_to_fine
