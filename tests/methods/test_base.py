"""What every method shares: its parts are learned, or stay as they are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest
import torch
from torch import nn

from devrf.data.batch import RayBatch
from devrf.errors import DevrfError
from devrf.methods.base import RayTrainable
from devrf.rendering.output import RenderOutput
from devrf.rendering.view import View


class Toy(RayTrainable):
    """Two parts of a few numbers."""

    name = "toy"

    def __init__(self, width: int = 3) -> None:
        super().__init__()
        self.canonical, self.deformation = nn.Linear(width, 3), nn.Linear(2, 1)

    def config(self) -> dict[str, Any]:
        return {"width": self.canonical.in_features}

    def forward(self, batch: RayBatch) -> RenderOutput:
        raise NotImplementedError

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        return {
            "canonical": self.canonical.parameters(),
            "deformation": self.deformation.parameters(),
        }

    def at(self, time: float) -> View:
        raise NotImplementedError


@pytest.mark.parametrize("part", ["canonical", "canon*"])
def test_frozen_parts_are_in_no_group_and_the_others_learn(part: str) -> None:
    model = Toy()
    with pytest.raises(DevrfError, match="'rest'.* canonical, deformation"):
        model.freeze([part, "rest"])  # nothing is half-done
    assert [group["name"] for group in model.param_groups()] == ["canonical", "deformation"]
    model.freeze([part])
    (group,) = model.param_groups()
    assert group["name"] == "deformation" and len(group["params"]) == 2
    model.freeze([])  # of another stage
    assert len(model.param_groups()) == 2


def test_a_protocol_that_a_method_does_not_learn_by_is_refused() -> None:
    class Together(Toy):
        protocols = ("joint", "dynamic")

    Toy().check_protocol("mine")  # what names none learns by all
    Together().check_protocol("dynamic")
    with pytest.raises(DevrfError, match="protocol=two_stage"):
        Together().check_protocol("two_stage")


def test_it_is_built_from_its_config_and_takes_its_state() -> None:
    model = Toy(width=5)
    other = Toy.from_config(model.config())
    other.load_stored_state(model.stored_state())
    assert other.size == model.size == (5 * 3 + 3) + (2 + 1)
    for one, same in zip(model.parameters(), other.parameters(), strict=True):
        assert torch.equal(one, same)
