"""Metrics of iterations, by hand."""

from __future__ import annotations

import torch

from devrf.engine.loop import MetricAccumulator


def test_means_over_iterations() -> None:
    metrics = MetricAccumulator()
    for factor in (1.0, 3.0):
        metrics.add({"render": torch.tensor(factor), "loss": torch.tensor(2 * factor)})
    means = metrics.take(2, processes=1)
    assert {name: float(mean) for name, mean in means.items()} == {"render": 2.0, "loss": 4.0}
    # The sums start again; returned means do not change.
    metrics.add({"render": torch.tensor(0.0), "loss": torch.tensor(1.0)})
    assert float(metrics.take(1, processes=1)["loss"]) == 1.0 and float(means["loss"]) == 4.0
