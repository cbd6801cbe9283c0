"""A device's queue, and the arithmetic that it is quick at."""

from __future__ import annotations

import torch


def wait(device: torch.device) -> None:
    """Wait until the device has done all queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether ``device`` multiplies bfloat16 faster: NVIDIA's GPUs from Ampere on.

    A CPU does not: oneDNN compiles its products anew for each number of samples.
    """
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)
