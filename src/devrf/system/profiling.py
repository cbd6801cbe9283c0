"""Names for the parts of an iteration, for torch.profiler; free where no profiler is active."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Literal

from torch.autograd import profiler

Part = Literal[
    "batch",
    "sampling",
    "decoder",
    "compositing",
    "losses",
    "backward",
    "optimiser",
]
_nothing = nullcontext()


def span(part: Part) -> AbstractContextManager[object]:
    """Record the block as ``part``, if a profiler is active; spans may be nested."""
    return profiler.record_function(part) if profiler._is_profiler_enabled else _nothing
