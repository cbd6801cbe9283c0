"""Launching a kernel."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def launch(kernel: Any, programs: int, on: Tensor, *args: Any, **constants: Any) -> None:
    """Launch a kernel.

    Args:
        kernel: a Triton kernel.
        programs: size of the grid; 0 launches nothing.
        on: a tensor on the device to run on, which need not be the current one.
        args: the kernel's arguments.
        constants: its constants, and Triton's options.
    """
    if programs:
        with torch.cuda.device_of(on):
            run(kernel, programs, *args, **constants)


def run(kernel: Any, programs: int, *args: Any, **constants: Any) -> None:
    """Launch on the current device; the one place where tests and benchmarks watch launches."""
    # Explicit, because its default differs between releases of Triton.
    kernel[(programs,)](*args, **constants, enable_fp_fusion=True)
