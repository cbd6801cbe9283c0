"""Protocols: which data trains which part."""

from __future__ import annotations

from typing import Any

import pytest

from devrf.engine.protocol import Protocol
from devrf.errors import DevrfError

STATIC = {"capture": "static", "iterations": 0.4}
MOVING = {"capture": "dynamic", "iterations": 0.6, "frozen": ["canonical"]}


def test_stages_keep_their_order() -> None:
    protocol = Protocol(
        "two_stage", {"canonical": STATIC, "deformation": {**MOVING, "builds_on": "canonical"}}
    )
    assert [stage.name for stage in protocol.order] == ["canonical", "deformation"]
    assert protocol["deformation"].frozen == ["canonical"]
    assert protocol["deformation"].builds_on == "canonical"


@pytest.mark.parametrize(
    ("stages", "said"),
    [
        ({"a": {**STATIC, "builds_on": "b"}, "b": MOVING}, r"stages\.a\.builds_on: .*'b'"),
        ({"a": {"capture": "all"}}, r"stages\.a\.capture: .*'all'"),
        ({"a": {**STATIC, "iterations": 0}}, r"stages\.a\.iterations: .*0"),
        ({"a": {**STATIC, "frames": 3}}, r"stages: .*'frames'"),
    ],
)
def test_what_cannot_be_is_named(stages: dict[str, dict[str, object]], said: str) -> None:
    with pytest.raises(DevrfError, match=f"protocol.{said}"):
        Protocol("mine", stages)


@pytest.mark.parametrize(
    ("freeze", "frozen"), [(True, ["canonical"]), (False, []), ("all", ["canonical*"])]
)
def test_what_is_frozen_can_be_chosen_at_once(freeze: Any, frozen: list[str]) -> None:
    protocol = Protocol("mine", {"canonical": STATIC, "deformation": MOVING}, freeze=freeze)
    assert list(protocol["deformation"].frozen) == frozen
    assert list(protocol["canonical"].frozen) == []
