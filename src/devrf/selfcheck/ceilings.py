"""How fast a device copies memory and multiplies matrices: what no kernel can exceed."""

from __future__ import annotations

import torch
from torch.utils.benchmark import Timer

from devrf.selfcheck.bench import Bench
from devrf.selfcheck.finding import Finding
from devrf.system.machine import multiplies_bfloat16

BYTES, SIDE = 2**30, 8192
ON_CPU_BYTES, ON_CPU_SIDE = 2**26, 1024


def ceilings(bench: Bench) -> Finding:
    """Bytes a second that are read and written, and operations a second.

    Products are in what the colour network computes in on this device by itself.
    """
    gpu = bench.device.type == "cuda"
    size, side = (BYTES, SIDE) if gpu else (ON_CPU_BYTES, ON_CPU_SIDE)
    precision = torch.bfloat16 if multiplies_bfloat16(bench.device) else torch.float32
    source = torch.zeros(size, dtype=torch.uint8, device=bench.device)
    copied = 2 * size / _seconds("into.copy_(source)", into=source.clone(), source=source)
    matrix = torch.ones(side, side, dtype=precision, device=bench.device)
    product = 2 * side**3 / _seconds("matrix @ matrix", matrix=matrix)
    name = str(precision).removeprefix("torch.")
    said = f"copies {copied / 1e9:.0f} GB/s, multiplies {product / 1e12:.3g} Top/s in {name}"
    figures = {"bytes_per_second": copied, "operations_per_second": product, "precision": name}
    return Finding(copied > 0 and product > 0, said, figures)


def _seconds(statement: str, **names: torch.Tensor) -> float:
    timer = Timer(statement, globals=names, num_threads=torch.get_num_threads())
    return float(timer.blocked_autorange(min_run_time=0.3).median)
