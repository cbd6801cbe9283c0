"""What a benchmark has found, as data and in words."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from rich.console import Console

from devrf.cli.benchmark_record import Benchmark, as_data
from devrf.cli.benchmark_text import plain, tables
from devrf.cli.roofline import Work
from devrf.cli.timing import PictureTiming, Spread, Timing


def steady(value: float) -> Spread:
    return Spread(value, 0.9 * value, 1.5 * value)


COARSE = Timing(
    stage="canonical",
    phase="search",
    resolution=(9, 8, 7),
    frames=(),
    rays=64,
    iterations=10,
    seconds=steady(0.02),
    measured_seconds=steady(0.03),
    parts={"sampling": steady(0.01), "overhead": steady(0.02)},
    counts={"tested": 1000.0, "opaque": 500.0, "reached": 400.0, "heavy": 123.4},
    work=Work(bytes=4e6, operations=2e6),
    allocated=None,
    reserved=None,
)
FINE = replace(
    COARSE,
    stage="deformation",
    phase="level 1",
    frames=(3,),
    parts={"warp": steady(0.005)},
    counts={"heavy": 5.0},
    work=None,
    allocated=2**30,
    reserved=3 * 2**29,
)
QUICK = replace(COARSE, seconds=steady(0.004))
PICTURE = PictureTiming(40, 30, 5, steady(0.1), steady(0.05), 0.0)


@pytest.fixture
def found() -> Benchmark:
    """Two resolutions, with two implementations."""
    return Benchmark(
        "robot",
        "from a checkpoint",
        copy_speed=1e9,
        product_speed=2e9,
        training={"torch": [COARSE, FINE], "triton": [QUICK, FINE]},
        pictures={"torch": PICTURE, "triton": replace(PICTURE, difference=3e-6)},
        notes=("something was not measured",),
    )


def test_the_data_have_units_in_their_names(found: Benchmark) -> None:
    data = json.loads(json.dumps(as_data(found)))
    assert list(data) == ["scene", "state", "device", "training", "rendering", "notes"]
    assert data["device"] == {"copy_gb_per_s": 1.0, "product_gflop_per_s": 2.0}
    assert [(row["kernels"], row["phase"]) for row in data["training"]] == [
        ("torch", "search"),
        ("triton", "search"),
        ("torch", "level 1"),
        ("triton", "level 1"),
    ]
    first = data["training"][0]
    assert first["ms"] == {"median": 20.0, "low": 18.0, "high": 30.0}
    assert first["iterations_per_s"] == 50 and first["measured_ms"]["median"] == 30
    assert first["parts_ms"]["sampling"]["median"] == 10 and first["samples"]["heavy"] == 123.4
    # 4 MB at 1 GB/s and 2 MFLOP at 2 GFLOP/s: 5 of 20 ms.
    assert first["floor"] == {
        "mb": 4.0,
        "gflop": 0.002,
        "ms": 5.0,
        "share": 0.25,
        "achieved_gb_per_s": 0.2,
    }
    last = data["training"][-1]
    assert last["floor"] is None and last["frames"] == [3]
    assert (last["allocated_gb"], last["reserved_gb"]) == (1.0, 1.5)
    assert data["rendering"][1] == {
        "kernels": "triton",
        "width": 40,
        "height": 30,
        "views": 5,
        "new_time_ms": {"median": 100.0, "low": 90.0, "high": 150.0},
        "same_time_ms": {"median": 50.0, "low": 45.0, "high": 75.0},
        "new_time_frames_per_s": 10.0,
        "same_time_frames_per_s": 20.0,
        "largest_difference": 3e-6,
    }


def test_the_same_in_words_for_a_log_and_for_a_terminal(found: Benchmark) -> None:
    console = Console(width=240, record=True, file=None, quiet=False)
    with console.capture() as shown:
        console.print(tables(found))
    for words in (plain(found), shown.get()):
        rows = [line.split() for line in words.splitlines()]
        # Parts in the order of the work; what was not done has a dash.
        assert ["grid", "kernels", "all", "lowest,", "highest", "sampling", "warp", "overhead"] in [
            row for row in rows
        ]
        split = [row for row in rows if row[:4] == ["canonical,", "search", "9x8x7", "triton"]]
        assert split[0][4:] == ["4", "3.6,", "6", "10", "-", "20"]
        assert split[1][4:] == [
            "250",
            "64",
            "1000",
            "500",
            "400",
            "123",
            "4.0",
            "MB",
            "1",
            "125",
            "%",
            "-",
            "-",
        ]
        fine = [row for row in rows if row[:4] == ["deformation,", "level", "1", "9x8x7"]]
        assert fine[2][5:] == [
            "50",
            "64",
            "-",
            "-",
            "-",
            "5",
            "-",
            "-",
            "-",
            "1.1",
            "GB",
            "1.6",
            "GB",
        ]
        assert ["triton", "40", "x", "30", "10", "20", "3e-06"] in rows
        assert "something was not measured" in words


def test_frames_that_were_visited_together_are_counted(found: Benchmark) -> None:
    together = replace(found, training={"torch": [replace(FINE, frames=(3, 10))]})
    assert "deformation, level 1, 2 frames" in plain(together)
    assert as_data(together)["training"][0]["frames"] == [3, 10]


def test_without_a_gpu_there_is_no_word_of_its_memory(found: Benchmark) -> None:
    alone = replace(found, training={"torch": [COARSE]})
    assert "GPU memory" in plain(found) and "GPU memory" not in plain(alone)
