"""Pixels and metrics of the batches of an iteration, by hand."""

from __future__ import annotations

import pytest
import torch

from devrf.data.batch import Pixels
from devrf.engine.learner import ParallelBatch
from devrf.engine.loop import MetricAccumulator, take
from devrf.rendering.sample_capacity import SampleCapacity


def pixels(start: int) -> Pixels:
    return Pixels(torch.arange(start, start + 3), torch.arange(3), torch.ones(3))


@pytest.mark.parametrize("static_shape", [False, True])
def test_pixels_of_a_static_batch_stay_in_the_same_memory(static_shape: bool) -> None:
    capacity = SampleCapacity(3, torch.device("cpu")) if static_shape else None
    batch = ParallelBatch(0, [], capacity)
    first, second = pixels(0), pixels(10)
    take(batch, first)
    held = batch.pixels
    assert held is not None and (held is first) == (not static_shape)
    take(batch, second)
    assert batch.pixels is (held if static_shape else second)
    assert batch.pixels.image.tolist() == [10, 11, 12] and second.image[0] == 10
    assert first.image.tolist() == [0, 1, 2]


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
