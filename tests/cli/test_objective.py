"""The one number that a run is judged by."""

from __future__ import annotations

import pytest

from devrf.cli.objective import check_objective, objective
from devrf.errors import DevrfError

FOUND = {
    "scene": "robot",
    "canonical": {"psnr": 30.0, "lpips": None},
    "deformation": {"psnr": 20.0, "seconds": 7.5},
}


def test_it_is_looked_up() -> None:
    assert objective("deformation.psnr", FOUND) == 20.0
    assert objective("deformation.seconds", FOUND) == 7.5
    assert objective("canonical.psnr", FOUND) == 30.0


def test_what_was_not_measured_is_none() -> None:
    assert objective("canonical.lpips", FOUND) is None


def test_where_nothing_moves_the_rest_state_is_judged() -> None:
    rest = {key: FOUND[key] for key in ("scene", "canonical")}
    assert objective("deformation.psnr", rest) == 30.0
    assert objective("deformation.rest_pose_psnr", rest) is None


@pytest.mark.parametrize(
    "key",
    ["deformation.psnr", "canonical.seconds", "deformation.rest_pose_psnr", "deformation.lpips"],
)
def test_what_metrics_will_have_may_be_asked_for(key: str) -> None:
    check_objective(key, ["lpips"])


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("psnr", "objective: expected canonical.NAME or deformation.NAME, not 'psnr'"),
        ("run.seed", "objective: expected canonical.NAME"),
        ("deformation.pnsr", "objective: deformation has no 'pnsr'; choose from psnr, ssim"),
        ("deformation.flow_error", "objective: deformation has no 'flow_error'"),
        ("canonical.rest_pose_psnr", "objective: canonical has no 'rest_pose_psnr'"),
    ],
)
def test_anything_else_is_a_mistake(key: str, said: str) -> None:
    with pytest.raises(DevrfError) as caught:
        check_objective(key, ["lpips"])
    assert str(caught.value).startswith(said)
