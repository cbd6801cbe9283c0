"""The composed config is checked against the parts it names."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import pytest
from omegaconf import DictConfig, OmegaConf

from devrf.cli.config_check import check_config
from devrf.errors import DevrfError


@dataclass
class Inner:
    size: int = 1


@dataclass
class Outer:
    root: str
    inner: Inner | None = None
    weights: Mapping[str, float] = field(default_factory=dict)


def forwarding(**anything: object) -> None:
    """A part that takes any setting."""


BASE = f"""
stage: pipeline
seed: 0
deterministic: false
output_dir: outputs
rehearse: false
resume: true
memory_check: true
priors: all
ckpt: null
scene: robot
outputs: outputs
method: devrf
facing: inward
objective: dynamic.psnr
kernels: auto
sizes: {{inner: {{_target_: {__name__}.Inner, size: 2}}}}
loss: {{fine: {{render: 1.0}}}}
outer:
  _target_: {__name__}.Outer
  root: there
  inner: ${{sizes.inner}}
  weights: ${{loss.fine}}
"""


def config(**changes: object) -> DictConfig:
    """A config whose ``outer`` takes ``inner`` and ``weights`` from elsewhere."""
    made = OmegaConf.create(BASE)
    for key, value in changes.items():
        OmegaConf.update(made, key.replace("__", "."), value, force_add=True)
    return made


@pytest.fixture(autouse=True)
def importable(monkeypatch, request):
    """Tests are no package; their module is put where Hydra looks for parts."""
    monkeypatch.setitem(sys.modules, __name__, request.module)


def test_a_sound_config_passes():
    check_config(config())


def test_a_value_may_be_typed_over_a_reference(composed):
    made = composed("deformation.flow_mean=samples", "trainer.deterministic=true")
    made.deformation.loss = {"render": 1.0}
    check_config(made)


def test_a_part_may_take_anything():
    check_config(config(more={"_target_": f"{__name__}.forwarding", "whatever": 1}))


def test_a_key_whose_only_reader_is_left_out_is_refused(composed):
    made = composed("schedule.seconds=60", "callbacks.time_budget=null")
    with pytest.raises(DevrfError, match=r"^schedule\.seconds: no part reads it; leave it out"):
        check_config(made)


@pytest.mark.parametrize(
    ("method", "key", "owner"),
    [
        ("dnerf", "sampling.rays_per_pixel", "schedule="),
        ("devrf", "ray_stage.schedule.rays", "method=dnerf, "),
    ],
)
def test_a_key_of_another_method_that_is_added_is_warned_of(
    composed, monkeypatch, caplog, method, key, owner
):
    """In a sweep over several methods it may be added to each, as docs/experiments.md says."""
    word = f"++{key}=2"
    made = composed(f"method={method}", word)
    monkeypatch.setattr("devrf.cli.config_check.overrides", lambda: [f"method={method}", word])
    check_config(made)
    said = f"{key}: nothing reads it here; it belongs to {owner}"
    assert [said in message for message in caplog.messages] == [True]
    caplog.clear()
    monkeypatch.setattr("devrf.cli.config_check.in_sweep", lambda: True)
    check_config(made)
    assert not caplog.messages


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outer__root": "???"}, "outer.root: required; give outer.root=PATH"),
        ({"outer__weights": [1, "???"]}, "outer.weights[1]: required; give "),
        ({"outer__rot": 1}, "outer.rot: no such key; did you mean outer.root?"),
        ({"sizes__inner__siez": 1}, "did you mean sizes.inner.size?"),
        ({"sizes__innr": {"size": 3}}, "sizes.innr.size: no part reads it; leave it out"),
        ({"loss__fien": {"render": 3.0}}, "loss.fien.render: no part reads it; leave it out"),
        ({"sizes__inner__size": "big"}, "sizes.inner.size: expected a valid integer, not 'big'"),
        ({"loss__fine__render": "high"}, "loss.fine.render: expected a valid number, not 'high'"),
        ({"seed": -1}, "seed: expected at least 0, not -1"),
        ({"seed": None}, "seed: expected a valid integer, not None"),
        ({"outer__root": "${nowhere}"}, "nowhere"),
    ],
)
def test_the_key_at_fault_is_named(changes, message):
    with pytest.raises(Exception) as caught:  # noqa: PT011 - OmegaConf's own for the last one
        check_config(config(**changes))
    assert message in str(caught.value)
    if message != "nowhere":
        assert isinstance(caught.value, DevrfError)


@pytest.mark.parametrize(
    ("hint", "fitting", "wrong"),
    [
        (int, [3], ["3", 3.0, True, None]),
        (float, [3, 3.5], [True, "a"]),
        (str, ["a"], [3]),
        (Path, ["a/b"], [3]),
        (Union[int, None], [None, 1], ["a"]),  # noqa: UP007 - the older spelling
        (Literal["one", "all"], ["one"], ["both"]),
        (Sequence[int], [[1, 2]], [[1, "a"], 1]),
        (Sequence[str], [["ab"]], ["ab"]),
        (Sequence[Sequence[float]], [[[0.0, 1]]], [[0.0]]),
        (Mapping[str, float], [{"color": 1}], [{"color": "high"}]),
        (Any, ["anything"], []),
        (Annotated[int, []], [3], ["a"]),  # which has no hash
        (Exception, [{"_target_": "pathlib.Path"}], ["x", 1]),  # only a part can have it
    ],
)
def test_values_of_each_type(monkeypatch, hint, fitting, wrong):
    monkeypatch.setitem(Inner.__annotations__, "size", hint)
    for value in fitting:
        check_config(config(sizes__inner__size=value))
    for value in wrong:
        with pytest.raises(DevrfError, match="^sizes.inner.size"):
            check_config(config(sizes__inner__size=value))
