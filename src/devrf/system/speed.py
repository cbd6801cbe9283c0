"""Waiting for a device, whose work is queued: before a clock is read or memory is given away."""

from __future__ import annotations

import torch


def wait(device: torch.device) -> None:
    """Return when the device has done all that it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
