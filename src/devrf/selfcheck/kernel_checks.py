"""Triton's kernels beside their PyTorch twins, on this device or in Triton's interpreter."""

from __future__ import annotations

import time

from devrf.ops.selfcheck import CASES, compare
from devrf.selfcheck.bench import Bench
from devrf.selfcheck.finding import Finding
from devrf.system.speed import wait

NAMES = tuple(case.__name__.replace("_", " ") for case in CASES)


def kernel(bench: Bench, name: str) -> Finding:
    """Whether both implementations of the function ``name`` agree; how long compiling took.

    What the second call takes less than the first is compilation, or reading what was compiled
    before.
    """
    case = CASES[NAMES.index(name)]
    before = time.perf_counter()
    found = compare(case, bench.device)
    wait(bench.device)
    between = time.perf_counter()
    compare(case, bench.device)
    wait(bench.device)
    again = time.perf_counter() - between
    compiled = max(0.0, between - before - again)
    interpreted = bench.device.type != "cuda"
    where = "in the interpreter" if interpreted else f"compiled in {compiled:.1f} s"
    return Finding(
        found.agrees,
        f"largest error {found.max_error:.2g}, {where}",
        {
            "max_error": found.max_error,
            "interpreted": interpreted,
            "compile_seconds": None if interpreted else round(compiled, 3),
        },
    )
