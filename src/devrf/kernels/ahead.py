"""Kernels compiled before they are needed, beside other work."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Sequence
from threading import Thread

import torch
import warp as wp

from devrf.kernels import (
    adam,
    compositing,
    deformation,
    march,
    photometric,
    pixels,
    splatting,
    trilinear,
)
from devrf.kernels.runtime import compiling, is_supported

log = logging.getLogger(__name__)

# Seconds; loading compiled kernels from disk takes less.
WAITED = 1.0
# Threads of a block, as in launches: kernels are compiled for this number.
THREADS = {"cpu": 1, "cuda": 256}


def march_kernels() -> list[wp.Kernel]:
    """The kernels of the march and its adjoints."""
    kernels = [march.march_kernel(False), march.keep_significant_kernel, march.adjoint_kernel]
    kernels += [march.scatter_kernel, pixels.look_up_kernel(True), compositing.composite_kernel]
    kernels += [photometric.photometric_kernel, deformation.cycle_kernel, deformation.flow_kernel]
    kernels.append(adam.total_variation_kernel(1))
    # The last one is for contracted space.
    return [*kernels, adam.adam_kernel(1), march.march_kernel(True)]


def grid_kernels(channels: Collection[int]) -> list[wp.Kernel]:
    """The kernels that interpolate and step grids of these numbers of channels."""
    kernels: list[wp.Kernel] = []
    for count in sorted({*channels}):
        kernels += [trilinear.interpolate_kernel(count), trilinear.slope_kernel(count)]
        kernels += [trilinear.add_kernel(count), adam.total_variation_kernel(count)]
        kernels.append(adam.adam_kernel(count))
    return kernels


def splatting_kernels() -> list[wp.Kernel]:
    """The kernels of a picture of Gaussians and its adjoint."""
    kernels = [splatting.project_kernel, splatting.list_kernel, splatting.composite_kernel]
    return [*kernels, splatting.composite_adjoint_kernel, splatting.project_adjoint_kernel]


def compile_ahead(kernels: Sequence[wp.Kernel], device: torch.device) -> Thread:
    """Compile kernels, or load them, in a thread of its own, which is returned.

    One line says so if that takes long; nothing is done where PyTorch takes their place.
    """
    wanted = kernels if is_supported(torch.empty(0, device=device)) else ()
    thread = Thread(target=_compile, args=(wanted, device), daemon=True)
    thread.start()
    return thread


def _compile(kernels: Sequence[wp.Kernel], device: torch.device) -> None:
    began = time.perf_counter()
    for number, kernel in enumerate(kernels):
        with compiling:
            kernel.module.load(wp.get_device(str(device)), THREADS[device.type])
        if number == 0 and time.perf_counter() - began > WAITED:
            folder = wp.config.kernel_cache_dir
            log.info("kernels are being compiled for this machine, once: %s keeps them", folder)
