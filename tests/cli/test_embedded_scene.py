"""An experiment beside an embedded scene is the one with sizes for the embedded scenes."""

from __future__ import annotations

import pytest

from devrf.cli.embedded_scene import with_embedded_experiment


@pytest.mark.parametrize(
    ("typed", "experiment"),
    [
        (["experiment=best_small", "data=procedural"], "experiment=best_small_procedural"),
        (["data=procedural", "experiment=best_small"], "experiment=best_small_procedural"),
        (["experiment=best_small", "data=flower"], "experiment=best_small_procedural"),
        (["experiment=best_small", "data=inward", "data.root=x"], "experiment=best_small"),
        (["experiment=best_small", "data.root=x"], "experiment=best_small"),
        (["experiment=quickstart", "data=procedural"], "experiment=quickstart"),
    ],
)
def test_it_is_chosen_where_there_is_one(typed: list[str], experiment: str) -> None:
    meant = with_embedded_experiment(typed)
    assert sorted(meant) == sorted(
        [experiment, *(one for one in typed if not one.startswith("experiment="))]
    )
