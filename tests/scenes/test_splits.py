"""Which images one fixed camera took: found from poses that are equal up to rounding."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from devrf.scenes.splits import SAME_POSE, distinct_poses


def one_by_one(poses: torch.Tensor) -> list[int]:
    """The definition: the first known pose of which no entry differs by more than the limit."""
    limit = SAME_POSE * (1 + float(poses[:, :, 3].norm(dim=1).median()))
    known: list[torch.Tensor] = []
    numbers = []
    for pose in poses.double():
        near = [float((pose - other).abs().max()) <= limit for other in known]
        numbers.append(near.index(True) if any(near) else len(known))
        if not any(near):
            known.append(pose)
    return numbers


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(-3, 3)), min_size=1, max_size=30))
def test_poses_are_told_apart_as_defined(drawn):
    cameras = torch.randn((6, 3, 4), generator=torch.Generator().manual_seed(0))
    # Steps of 0.6 of the limit: neighbours are the same camera, others are not.
    poses = torch.stack([cameras[k] + 0.6 * SAME_POSE * step for k, step in drawn])
    assert distinct_poses(poses).tolist() == one_by_one(poses)


def test_a_moving_camera_with_many_images_takes_a_moment():
    poses = torch.randn((20_000, 3, 4), generator=torch.Generator().manual_seed(0))
    assert distinct_poses(poses).tolist() == list(range(20_000))
