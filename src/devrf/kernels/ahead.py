"""Kernels compiled before they are needed, beside other work."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Sequence
from threading import Thread

import torch
import warp as wp

from devrf.kernels import adam, look_up, march
from devrf.kernels.runtime import compiling, take

log = logging.getLogger(__name__)

# With compiled kernels on disk, loading them takes less.
WAITED = 1.0
# Of a block, as launches have them: kernels are compiled for their number.
THREADS = {"cpu": 1, "cuda": 256}


def compile_ahead(channels: Collection[int], device: torch.device) -> None:
    """Compile DeVRF's kernels, or load them, in a thread of its own.

    One line says so if that takes long.

    Args:
        channels: of the grids that are looked up, beside densities and displacements.
        device: where the kernels will run.
    """
    if not take(torch.empty(0, device=device)):
        return
    kernels = [march.enter_kernel, march.march_kernel(False), march.keep_significant_kernel]
    kernels += [march.adjoint_kernel, look_up.add_kernel(1), adam.total_variation_kernel(1)]
    for count in sorted({3, *channels}):
        kernels += [look_up.look_up_kernel(count), look_up.slope_kernel(count)]
        kernels += [look_up.add_kernel(count), adam.total_variation_kernel(count)]
    kernels += [adam.adam_kernel(count) for count in sorted({1, *channels})]
    kernels.append(march.march_kernel(True))  # in contracted space
    Thread(target=_compile, args=(kernels, device), daemon=True).start()


def _compile(kernels: Sequence[wp.Kernel], device: torch.device) -> None:
    began = time.perf_counter()
    for number, kernel in enumerate(kernels):
        with compiling:
            kernel.module.load(wp.get_device(str(device)), THREADS[device.type])
        if number == 0 and time.perf_counter() - began > WAITED:
            folder = wp.config.kernel_cache_dir
            log.info("kernels are being compiled for this machine, once: %s keeps them", folder)
