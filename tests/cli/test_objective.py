"""The one number that a run is judged by."""

from __future__ import annotations

import pytest
from devrf.cli.evaluate import check_objective, objective

from devrf.errors import DevrfError

FOUND = {
    "scene": "robot",
    "static": {"psnr": 30.0, "lpips": None},
    "dynamic": {"psnr": 20.0, "seconds": 7.5},
}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("dynamic.psnr", 20.0),
        ("dynamic.seconds", 7.5),
        ("static.psnr", 30.0),
        ("static.lpips", None),  # not measured
        # DeVRF's sections have the names of its stages, too.
        ("deformation.psnr", 20.0),
        ("canonical.psnr", 30.0),
    ],
)
def test_it_is_looked_up(key: str, value: float | None) -> None:
    check_objective(key, ["lpips"])
    assert objective(key, FOUND) == value


def test_where_nothing_moves_the_rest_state_is_judged() -> None:
    rest = {key: FOUND[key] for key in ("scene", "static")}
    check_objective("dynamic.rest_pose_psnr", ())
    assert objective("dynamic.psnr", rest) == 30.0
    assert objective("dynamic.rest_pose_psnr", rest) is None


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("psnr", "objective: expected static.NAME or dynamic.NAME, not 'psnr'"),
        ("run.seed", "objective: expected static.NAME or dynamic.NAME, not 'run.seed'"),
        ("dynamic.pnsr", "objective: dynamic has no 'pnsr'; choose from psnr, ssim"),
        ("deformation.flow_error", "objective: deformation has no 'flow_error'"),
        ("static.rest_pose_psnr", "objective: static has no 'rest_pose_psnr'"),
    ],
)
def test_anything_else_is_an_error(key: str, said: str) -> None:
    with pytest.raises(DevrfError) as caught:
        check_objective(key, ["lpips"])
    assert str(caught.value).startswith(said)
