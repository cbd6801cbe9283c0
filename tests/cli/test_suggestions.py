"""What is nearly right is answered with what is right, before anything heavy is loaded."""

from __future__ import annotations

import pytest

import devrf as package
from devrf.cli.stages import STEPS, known_stages
from devrf.cli.steps import STEPS as TAKEN


@pytest.mark.parametrize(
    ("argument", "meant"),
    [
        ("train", "stage=pipeline"),
        ("render", "stage=render"),
        ("canonical", "stage=canonical"),
        ("joint", "protocol=joint"),
        ("reprot", "stage=report"),
        ("download", "stage=fetch"),
        ("convert", "stage=export"),
        ("quickstart", "experiment=quickstart"),
        ("fox", "data.root=fox"),
        ("experiment=quickstrat", "experiment=quickstart"),
        ("stage=evalute", "stage=evaluate"),
        ("stage=train", "stage=pipeline"),
        ("data=inwrad", "data=inward"),
        ("kernels=tritn", "kernels=triton"),
        ("data.shape=robto", "data.shape=robot"),
        ("report.published=al", "report.published=all"),
        ("objective=dynamic.pnsr", "objective=dynamic.psnr"),
        ("evaluation.metrics=[lpisp]", "lpips"),
    ],
)
def test_the_closest_is_named(devrf, tmp_path, argument, meant):
    if argument == "fox":
        (tmp_path / "fox").mkdir()
    outcome = devrf(argument)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: {argument.split('=')[0]}")
    assert outcome.err.endswith(f"did you mean {meant}?\n")


@pytest.mark.parametrize("argument", ["xyzzy", "kernels=xyzzy", "data=xyzzy"])
def test_nothing_is_guessed_from_afar(devrf, argument):
    outcome = devrf(argument)
    assert outcome.status == 2 and "did you mean" not in outcome.err


def test_the_stages_named_are_those_there_are():
    assert set(STEPS) == set(TAKEN)
    assert set(known_stages()) == {"pipeline", "canonical", "deformation", "joint", "dynamic"} | {
        *TAKEN
    }


def test_the_version_is_devrfs(devrf):
    outcome = devrf("--version")
    assert (outcome.status, outcome.out) == (0, f"devrf {package.__version__}\n")
