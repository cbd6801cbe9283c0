"""``experiment=paper`` is the published schedule of each scene, to the number.

Sources: the supplementary material, section A; per scene the authors' configuration.
"""

from __future__ import annotations

import pytest
from hydra.utils import instantiate

from devrf.geometry.box import Box
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.deformation_schedule import PAPER_LEVELS, Visits
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import (
    DEFORMATION_LOSS,
    FINE_LOSS,
    SEARCH_LOSS,
    CanonicalRates,
    Sampling,
    VisitSettings,
)

ROOT = "data.root=scene"


@pytest.fixture
def paper(composed):
    """The composed experiment."""
    return composed("experiment=paper", "data=inward", ROOT)


def test_canonical_schedule(paper):
    schedule = instantiate(paper.schedule.canonical, _convert_="all")
    # tests/methods/devrf/test_deformation_schedule.py has the phases of this.
    assert schedule == CanonicalSchedule(upsample_at=[1000, 2000, 3000, 4000])
    assert (schedule.rays, schedule.visual_hull_init, schedule.min_views) == (8192, False, 3)
    # A tenth over every 20 000 iterations, anew from the last growth.
    assert schedule.learning_rate_factor(9000) == 1.0
    assert schedule.learning_rate_factor(29_000) == pytest.approx(0.1)


def test_deformation_schedule(paper):
    schedule = instantiate(paper.schedule.deformation, _convert_="all")
    assert (tuple(schedule.levels), schedule.rays) == (PAPER_LEVELS, 8192)
    visit = instantiate(paper.schedule.visit)
    assert (visit.learning_rate, visit.unit) == (1e-3, "world")
    factors = [Visits(schedule, 50).phase(i).rate_factor for i in (0, 24_999)]
    assert factors == pytest.approx([1, 0.1])
    # A batch is drawn from all pixels of one view.
    assert (visit.views, visit.pixels) == ("one", "all")


def test_rates_field_and_sampling(paper):
    rates, field = instantiate(paper.schedule.rates), instantiate(paper.field)
    assert (rates.density, rates.color, rates.decoder) == (0.1, 0.1, 1e-3)
    assert (field.channels, field.width, field.frequencies) == (12, 128, 4)
    assert (field.alpha_init, field.search_alpha_init) == (1e-2, 1e-6)
    sampling = instantiate(paper.sampling)
    assert (sampling.step, sampling.alpha_threshold) == (0.5, 1e-4)
    assert sampling.occupancy_threshold == 1e-3


def test_loss_weights(paper):
    assert dict(paper.loss.search) == {"render": 1.0, "per_sample_color": 0.1, "entropy": 0.01}
    fine = {"render": 1.0, "per_sample_color": 0.01, "entropy": 0.001, "alpha_mask": 0.0, "tv": 0.0}
    assert dict(paper.loss.fine) == fine
    assert dict(paper.loss.deformation) == {
        "render": 1.0,
        "cycle": 100.0,
        "flow": 0.005,
        "tv": 1.0,
        "per_sample_color": 0.1,
        "entropy": 0.01,
        "elastic": 0.0,
        "bending": 0.0,
        "alpha_mask": 0.0,
    }


def test_the_code_defaults_to_the_paper(paper, rest):
    assert DeformationStage(rest).flow_mean == paper.deformation.flow_mean == "samples"
    assert instantiate(paper.field) == Architecture()
    assert instantiate(paper.sampling) == Sampling()
    assert instantiate(paper.schedule.rates) == CanonicalRates()
    # The store changes nothing that is learned.
    assert instantiate(paper.schedule.visit) == VisitSettings(store="host")
    assert dict(paper.loss.search) == SEARCH_LOSS
    assert dict(paper.loss.fine) == FINE_LOSS
    # Weights of extensions' terms are beside them in conf alone; they are 0.
    assert {k: v for k, v in paper.loss.deformation.items() if v} == {
        k: v for k, v in DEFORMATION_LOSS.items() if v
    }


@pytest.mark.parametrize(
    ("ablation", "off"),
    [
        ("base", {"tv", "cycle", "flow"}),
        ("c2f", {"tv", "cycle", "flow"}),
        ("c2f_tv", {"cycle", "flow"}),
        ("c2f_tv_cycle", {"flow"}),
        ("full", set()),
    ],
)
def test_the_rows_of_the_ablation_tables(composed, ablation, off):
    config = composed("experiment=paper", "data=inward", ROOT, f"ablation={ablation}")
    without = {name for name, weight in config.loss.deformation.items() if not weight}
    assert without == off | {"elastic", "bending", "alpha_mask"}
    assert config.schedule.deformation.coarse_to_fine is (ablation != "base")
    # Where other settings start a frame better, these rows start it from the one before.
    starts = composed("experiment=quickstart", f"ablation={ablation}").schedule.extensions
    as_the_paper = starts.tracks.init_from == "previous" and not starts.frame_start.levels
    assert (as_the_paper and not starts.frame_start.gaussians) is (ablation != "full")


@pytest.mark.parametrize("scene", ["lego", "flower_360"])  # the others are alike
def test_the_inward_scenes_have_the_papers_schedule_and_the_authors_bound_scale(composed, scene):
    config, general = (
        composed("experiment=paper", f"data={scene}", ROOT),
        composed("experiment=paper", "data=inward", ROOT),
    )
    assert (config.data.name, config.data.bound_scale, config.data.space) == (scene, 1.2, "world")
    for part in ("field", "schedule", "sampling", "loss"):
        assert config[part] == general[part]
    assert config.loss.flow_mean == "samples"


@pytest.mark.parametrize(
    ("scene", "frames", "sides", "growths", "total", "factor", "finest"),
    [
        (
            "pig_toy",
            50,
            [10, 20, 40, 80, 160],
            [10_000, 15_000, 20_000, 22_500],
            25_000,
            0.5623,
            178,
        ),
        ("rabbit", 40, [40, 80, 160], [8000, 12_000], 13_000, 0.3162, 178),
        ("plant", 40, [8, 16, 32, 64, 128], [8000, 16_000, 20_000, 22_000], 24_000, 0.5623, 128),
    ],
)
def test_each_forward_scene_has_its_published_schedule(
    composed, scene, frames, sides, growths, total, factor, finest
):
    config = composed("experiment=paper", f"data={scene}", ROOT)
    schedule = instantiate(config.schedule.deformation, _convert_="all")
    assert (config.data.name, [level.side for level in schedule.levels]) == (scene, sides)
    visits = Visits(schedule, frames)
    assert (visits.level_starts, visits.total) == (growths, total)
    # 128 planes at the end, halved from level to level downwards.
    cube = Box((-1.0,) * 3, (1.0,) * 3)
    shapes = [cube.grid_shape(*schedule.grid(k)) for k in range(len(sides))]
    assert [z for *_, z in shapes] == [128 // 2**k for k in reversed(range(len(sides)))]
    assert shapes[-1] == (finest, finest, 128)
    # From growth to growth down to a tenth.
    assert schedule.level_rate_factor(1) == pytest.approx(factor, abs=1e-4)
    assert schedule.level_rate_factor(len(sides) - 1) == pytest.approx(0.1)
    assert config.schedule.canonical.dense_tv_iterations == 10_000
    assert config.loss.flow_mean == "samples"
    assert (config.field.planes, config.field.channels, config.field.width) == (128, 9, 64)


@pytest.mark.parametrize(
    ("scene", "row"),
    [("lego", "devrf_paper"), ("pig_toy", "devrf_paper_c2f"), ("plant", "devrf_paper")],
)
def test_a_job_of_the_published_table_is_the_scenes_own_experiment(composed, scene, row):
    job = composed("experiment=published_table", f"comparison={row}", f"data={scene}", ROOT)
    ablation = f"ablation={row.removeprefix('devrf_paper').removeprefix('_') or 'full'}"
    own = composed("experiment=paper", f"data={scene}", ROOT, ablation)
    for part in ("data", "field", "schedule", "sampling", "loss", "protocol"):
        assert job[part] == own[part]
