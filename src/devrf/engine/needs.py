"""Estimates of the memory that a stage needs: of what is large.

Counted are the images, the fields with their gradients and Adam's state, and a batch. The rest is
small beside them; where memory runs out all the same, batches are halved
(:mod:`devrf.engine.batch_size`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass

from torch import Tensor

# The key by which images are made smaller.
SIZE = "data.downscale"
# Values, gradients, Adam's two means, and the copy that a rollback returns to.
LEARNED = 5


@dataclass(frozen=True)
class StageNeeds:
    """Bytes that a stage needs.

    Attributes:
        parts: on the device that trains, by the config key that changes them most: the batch by
            that of its rays.
        learned: the values of the fields, by the key that changes their number most.
    """

    parts: Mapping[str, float]
    learned: Mapping[str, float]

    def with_batches(self, share: float) -> StageNeeds:
        """The needs with a ``share`` of each batch."""
        parts = {k: s * (share if k.endswith(".rays") else 1) for k, s in self.parts.items()}
        return StageNeeds(parts, self.learned)


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
