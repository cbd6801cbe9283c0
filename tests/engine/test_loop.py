"""Metrics of the batches of an iteration, by hand."""

from __future__ import annotations

import torch

from devrf.engine.loop import MetricAccumulator


def test_means_of_all_batches_and_the_loss_of_each() -> None:
    metrics = MetricAccumulator()
    for factor in (1.0, 3.0):
        metrics.add(
            [
                {"render": torch.tensor(factor), "loss": torch.tensor(2 * factor)},
                {"render": torch.tensor(5 * factor), "loss": torch.tensor(4 * factor)},
            ]
        )
    means, losses = metrics.take(2, processes=1)
    assert {name: float(mean) for name, mean in means.items()} == {"render": 6.0, "loss": 6.0}
    assert losses.tolist() == [4.0, 8.0]
    # The sums start again; returned means do not change.
    metrics.add(
        [
            {"render": torch.tensor(0.0), "loss": torch.tensor(1.0)},
            {"render": torch.tensor(0.0), "loss": torch.tensor(7.0)},
        ]
    )
    assert metrics.take(1, processes=1)[1].tolist() == [1.0, 7.0] and losses.tolist() == [4.0, 8.0]
