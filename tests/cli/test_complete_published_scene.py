"""A folder named as one of the paper's scenes: experiment=paper names that scene's choice."""

from __future__ import annotations

import pytest

from devrf.cli.complete import completed


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("experiment=paper data=inward", True),
        ("experiment=paper data=lego", False),
        ("data=inward", False),
    ],
)
def test_the_choice_of_the_scene_is_named(typed, said):
    remarks = completed([*typed.split(), "data.root=scenes/lego"]).remarks
    line = "scenes/lego: if it is DeVRF's, data=lego has what is published for it"
    assert (remarks == [line]) is said
