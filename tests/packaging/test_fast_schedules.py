"""How much shorter the fast schedules are than the paper's."""

from __future__ import annotations

import pytest
from hydra.utils import instantiate

from devrf.cli.config_check import check_config


def sides(schedule):
    return [level.side for level in schedule.levels]


@pytest.mark.parametrize(
    ("overrides", "paper", "frames", "canonical", "deformation", "of_paper"),
    [
        # 80 · 50, then visits of 7, 7, 13 and 25 moments.
        (["experiment=paper_inward", "schedule=fast"], "paper_inward", 50, 5000, 5520, 50000),
        # 80 · 40, then visits of 5, 5, 10 and 20 moments.
        (["experiment=fast_forward"], "paper_forward", 40, 5000, 4350, 44000),
    ],
)
def test_iterations(composed, overrides, paper, frames, canonical, deformation, of_paper):
    config = composed(*overrides, "data.root=x")
    check_config(config)
    rest = instantiate(config.schedule.canonical, _convert_="all")
    moves = instantiate(config.schedule.deformation, _convert_="all")
    assert (rest.total, moves.total(frames)) == (canonical, deformation)
    usual = composed(f"experiment={paper}", "data.root=x")
    before = instantiate(usual.schedule, _convert_="all")
    assert before["canonical"].total + before["deformation"].total(frames) == of_paper
    # The same grids, which are as fine as they get well before the end.
    assert rest.side == before["canonical"].side
    assert sides(moves) == sides(before["deformation"])
    assert max(rest.upsample_at) < canonical / 2
    assert config.schedule.extensions.tracks.init_from == "flow"
    assert config.schedule.motion.views == "all"
