"""Waiting for a device, whose work is queued."""

from __future__ import annotations

import torch


def wait(device: torch.device) -> None:
    """Return when the device has done all that is queued."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
