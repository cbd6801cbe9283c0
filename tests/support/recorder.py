"""Records what iterations ask of the device: operations, launches of kernels, and waits."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import pytest
import torch
import warp as wp
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from devrf.engine.stage import Stage, Terms
from devrf.kernels import runtime

# Operations that reserve memory, or mark a part of an iteration for a profiler.
ON_HOST = (
    "aten::empty",
    "aten::new_empty",
    "aten::_unsafe_view",
    "aten::is_same_size",
    "profiler::",
)
# Operations whose result, or its size, the host waits for.
WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "equal", "bincount")


class Entry(NamedTuple):
    """An operation or launch that reaches the device, with its tensors' shapes and its numbers."""

    name: str
    arguments: tuple[Any, ...]

    @property
    def waits(self) -> bool:
        """Whether the host waits for it."""
        by_mask = self.name == "aten::index" and "torch.bool" in str(self.arguments[1:])
        return by_mask or any(word in self.name for word in WAITS)


class Recorder(TorchDispatchMode):
    """Keeps all that reaches the device within its context: no views, no reserved memory."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[Entry] = []
        self._patch = pytest.MonkeyPatch()

    def __enter__(self) -> Recorder:
        usual = runtime._commands

        def watched(kernel: wp.Kernel, parts: int, inputs: Any, device: torch.device) -> Any:
            self.entries.append(Entry(kernel.key, outline(inputs)))
            return usual(kernel, parts, inputs, device)

        self._patch.setattr(runtime, "_commands", watched)
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._patch.undo()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        schema = func._schema
        aliases = [result.alias_info for result in schema.returns]
        is_view = any(alias is not None and not alias.is_write for alias in aliases)
        if not is_view and not schema.name.startswith(ON_HOST):
            self.entries.append(Entry(schema.name, outline([*args, *kwargs.values()])))
        return func(*args, **kwargs)


def outline(values: Any) -> tuple[Any, ...]:
    """Shapes and types in place of tensors and arrays; numbers and sequences as they are."""

    def of(value: Any) -> Any:
        if isinstance(value, Tensor | wp.array):
            return tuple(value.shape), str(value.dtype)
        if isinstance(value, list | tuple):
            return outline(value)
        return value if isinstance(value, int | float) else type(value).__name__

    return tuple(of(value) for value in values)


def by_samples(entries: list[Entry]) -> list[str]:
    """An iteration's entries with K in place of its number of samples, the optimiser's by name."""
    (count,) = {entry.arguments[1][0][0] for entry in entries if entry.name == "composite_kernel"}
    return [
        entry.name
        if "adam" in entry.name or entry.name == "aten::full"
        else re.sub(rf"\b{count}\b", "K", str(entry))
        for entry in entries
    ]


def recording(stage_type: type[Stage], iterations: list[list[Entry]]) -> type[Any]:
    """The stage, with what each of its iterations asks of the device added to ``iterations``."""

    class Recorded(stage_type):  # type: ignore[misc, valid-type]
        def iterate(self, views: Any) -> Terms:
            with Recorder() as recorder:
                terms: Terms = super().iterate(views)
            iterations.append(recorder.entries)
            return terms

    return Recorded
