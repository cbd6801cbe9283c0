"""Sums of losses and their terms over the iterations of a Lightning step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from devrf.engine.ddp import average


class MetricAccumulator:
    """Sums by name for each parallel batch, in the same memory from the first :meth:`add` on."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._values: Tensor | None = None  # (batches, names)

    def add(self, found: Sequence[Mapping[str, Tensor]]) -> None:
        """Add the values () of an iteration, by name for each batch; all have the same names."""
        self._names = tuple(found[0])
        values = [terms[name] for terms in found for name in self._names]
        if self._values is None:
            self._values = torch.stack(values).view(len(found), len(self._names))
        else:
            torch._foreach_add_(self._values.view(-1).unbind(), values)

    def take(self, iterations: int) -> tuple[dict[str, Tensor], Tensor]:
        """The means over ``iterations`` and all processes; the sums are set to zero.

        Returns:
            For each name the mean over the batches, (); for each batch its ``loss``, (batches,).
        """
        assert self._values is not None
        means = average(self._values) / iterations
        self._values.zero_()
        over_batches = means.mean(dim=0).unbind()
        return dict(zip(self._names, over_batches, strict=True)), means[
            :, self._names.index("loss")
        ]
