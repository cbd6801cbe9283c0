"""Estimates of the memory that a stage needs: of what is large.

Counted are the images, the fields with their gradients and Adam's state, and a batch. The rest is
small beside them; where memory runs out all the same, batches are halved
(:mod:`devrf.engine.stage`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass

from torch import Tensor

# Values, gradients, Adam's two means, and the copy that a rollback returns to.
LEARNED = 5


@dataclass(frozen=True)
class StageNeeds:
    """Bytes that a stage needs.

    Attributes:
        parts: on the device that trains, by the config key that changes them most: the batch by
            that of its rays.
        learned: the values of the fields.
    """

    parts: Mapping[str, float]
    learned: float

    def peak(self, batch_share: float = 1.0) -> float:
        """Bytes on the device, with ``batch_share`` of each batch."""
        batch = sum(size for key, size in self.parts.items() if key.endswith(".rays"))
        return sum(self.parts.values()) - batch * (1 - batch_share)


def tensor_bytes(value: object) -> int:
    """Bytes of all tensors in a dataclass (nested too) or an iterable."""
    if isinstance(value, Tensor):
        return value.nbytes
    if is_dataclass(value):
        # Without the names of images, which may be many.
        parts = (field.name for field in fields(value) if field.name != "names")
        return tensor_bytes(getattr(value, part) for part in parts)
    if isinstance(value, Iterable) and not isinstance(value, str):
        return sum(map(tensor_bytes, value))
    return 0
