"""Modules whose tensors take the shape that they were stored with."""

from __future__ import annotations

from typing import Any, ClassVar

from torch import nn


class StoredShape(nn.Module):
    """A module that may be loaded from a state of another resolution.

    Attributes:
        resizable: names of the parameters and buffers that take the stored shape.
    """

    resizable: ClassVar[tuple[str, ...]]

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        for name in self.resizable:
            stored, own = state_dict.get(prefix + name), getattr(self, name)
            if stored is not None and stored.shape != own.shape:
                empty = own.new_empty(stored.shape)
                setattr(self, name, nn.Parameter(empty) if name in self._parameters else empty)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
