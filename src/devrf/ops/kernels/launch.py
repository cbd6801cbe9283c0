"""How a kernel is started."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def launch(kernel: Any, programs: int, on: Tensor, *args: Any, **constants: Any) -> None:
    """Start ``programs`` programs of a kernel on the device of a tensor; none if there are none.

    Args:
        kernel: a Triton kernel.
        programs: how many; each does its own part.
        on: a tensor on the device to run on, which need not be the current one.
        args: the kernel's arguments.
        constants: its constants, and Triton's options.
    """
    if programs:
        with torch.cuda.device_of(on):
            # Said here, since releases of Triton differ in what they do if it is not.
            kernel[(programs,)](*args, **constants, enable_fp_fusion=True)
