"""What belongs to each batch of an iteration, by hand."""

from __future__ import annotations

import pytest
import torch

from devrf.data.batch import Pixels
from devrf.engine.parallel_batch import MetricAccumulator, ParallelBatch
from devrf.rendering.sample_capacity import SampleCapacity


def pixels(start: int) -> Pixels:
    return Pixels(torch.arange(start, start + 3), torch.arange(3), torch.ones(3))


@pytest.mark.parametrize("steady", [False, True])
def test_a_steady_lane_has_its_pixels_in_the_same_memory(steady: bool) -> None:
    lane = ParallelBatch(0, [], SampleCapacity(3, torch.device("cpu")) if steady else None)
    first, second = pixels(0), pixels(10)
    lane.take(first)
    held = lane.pixels
    assert held is not None and (held is first) == (not steady)
    lane.take(second)
    assert lane.pixels is (held if steady else second)
    assert lane.pixels.image.tolist() == [10, 11, 12] and second.image[0] == 10
    assert first.image.tolist() == [0, 1, 2]


def test_means_of_all_lanes_and_the_loss_of_each() -> None:
    sums = MetricAccumulator()
    for factor in (1.0, 3.0):
        sums.add(
            [
                {"render": torch.tensor(factor), "loss": torch.tensor(2 * factor)},
                {"render": torch.tensor(5 * factor), "loss": torch.tensor(4 * factor)},
            ]
        )
    means, losses = sums.take(2)
    assert {name: float(mean) for name, mean in means.items()} == {"render": 6.0, "loss": 6.0}
    assert losses.tolist() == [4.0, 8.0]
    # What was taken is gone, and what was given stays.
    sums.add(
        [
            {"render": torch.tensor(0.0), "loss": torch.tensor(1.0)},
            {"render": torch.tensor(0.0), "loss": torch.tensor(7.0)},
        ]
    )
    assert sums.take(1)[1].tolist() == [1.0, 7.0] and losses.tolist() == [4.0, 8.0]
