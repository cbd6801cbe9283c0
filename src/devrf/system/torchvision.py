"""A torchvision that was built for another torch counts as not installed."""

from __future__ import annotations

import importlib

from lightning_utilities.core.imports import RequirementCache


def pass_over_unusable() -> None:
    """Have a torchvision that cannot be imported count as not installed.

    torchmetrics, and with it Lightning, imports torchvision wherever it is installed; nothing
    here uses that part of it. pip installs CUDA's build beside a CPU's torch without a word.
    """
    installed = RequirementCache.__bool__

    def usable(self: RequirementCache) -> bool:
        if self.requirement != "torchvision":
            return installed(self)
        try:
            importlib.import_module("torchvision")
        except Exception:  # a RuntimeError, or another error of its parts
            return False
        return True

    RequirementCache.__bool__ = usable  # type: ignore[method-assign]
