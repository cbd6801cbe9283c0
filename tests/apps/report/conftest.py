"""Folders as runs leave them, without running anything."""

from __future__ import annotations

import csv
import json

import pytest

from devrf.apps.report.runs import collect
from devrf.apps.report.table import published, tabulate


@pytest.fixture
def runs(tmp_path):
    """The folder that the runs of a test lie in."""
    folder = tmp_path / "runs"
    folder.mkdir()
    return folder


@pytest.fixture
def ran(runs):
    """``ran(name, …)``: leaves a finished run in ``runs/name`` and returns its folder."""

    def write(
        name,
        scene="robot",
        *,
        method="devrf",
        protocol="two_stage",
        scores=None,
        seconds=(10.0, 20.0),
        gpu=(None, None),
        ablation="full",
        choices=None,
        curve=(),
        at_rest=False,
        **of_run,
    ):
        choices = choices or {}
        learned = {f"{key}.chosen": value for key, value in choices.items() if key != "logger"}
        sections = {
            "static": {"psnr": 33.0, "seconds": seconds[0], "peak_gpu_gb": gpu[0]},
            "dynamic": {"psnr": 29.0, "ssim": 0.95, "lpips": None, **(scores or {})}
            | {"seconds": seconds[1], "peak_gpu_gb": gpu[1]},
        }
        usual = {"device": "a processor", "git": "0123456789abcdef", "overrides": [], "seed": 0}
        usual |= {"benchmark": published().benchmark} if scene in published().texts.index else {}
        named = {"ablation": ablation, "method": method, "protocol": protocol, "data": scene}
        named |= choices
        settings = {"loss.terms": ablation, **learned}
        run = {**usual, "choices": named, "settings": settings, **of_run}
        record = {"scene": scene, "method": method, "protocol": protocol, **sections, "run": run}
        record |= {"at_rest": True, "dynamic": {}} if at_rest else {}
        folder = runs / name
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps(record))
        if curve:
            with (folder / "frames.csv").open("w", newline="") as file:
                table = csv.writer(file)
                table.writerow(["capture", "name", "time", "psnr", "ssim"])
                table.writerow(["static", "at rest", 0, 40, 0.9])
                table.writerows(["dynamic", f"m{t}", t, psnr, ""] for t, psnr in curve)
        return folder

    return write


@pytest.fixture
def failed(runs):
    """``failed(name, error, …)``: leaves the record of a failed job in ``runs/name``."""

    def write(name, error, **further):
        setup = {"choices": {"ablation": "base"}, "overrides": ["ablation=base"], "seed": 0}
        record = {"scene": "robot", **setup, "error": error, "mistake": True}
        folder = runs / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "failure.json").write_text(json.dumps({**record, **further}))

    return write


@pytest.fixture
def table(runs):
    """``table(…)``: the table of what lies in the folder."""
    return lambda: tabulate(collect(runs))
