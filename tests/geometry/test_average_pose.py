"""The average of poses, by hand."""

from __future__ import annotations

import math

import torch

from devrf.geometry.average_pose import average_pose, relative_to


def turned(angle: float, position: list[float]) -> torch.Tensor:
    """A pose turned about y by ``angle``."""
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    return torch.cat([rotation, torch.tensor(position, dtype=torch.float64)[:, None]], dim=1)


def test_between_two_turns_and_two_places() -> None:
    poses = torch.stack([turned(0.5, [0, 0, 0]), turned(0.1, [2, 4, 6])])
    torch.testing.assert_close(average_pose(poses), turned(0.3, [1, 2, 3]))


def test_up_gives_way_where_it_is_not_across() -> None:
    # z axes agree, y axes lean to either side of the y axis: their mean is across.
    poses = torch.eye(3, 4, dtype=torch.float64).repeat(2, 1, 1)
    for pose, angle in zip(poses, (0.4, -0.4), strict=True):
        c, s = math.cos(angle), math.sin(angle)
        pose[:2, :2] = torch.tensor([[c, -s], [s, c]])
    torch.testing.assert_close(average_pose(poses)[:, :3], torch.eye(3, dtype=torch.float64))


def test_a_pose_relative_to_another() -> None:
    pose = turned(0.7, [1, -2, 5])
    # The second camera is one unit to the right of the first, along its own x axis.
    beside = torch.cat([pose[:, :3], pose[:, 3:] + pose[:, :1]], dim=1)
    found = relative_to(pose, torch.stack([pose, beside]))
    expected = torch.eye(3, 4, dtype=torch.float64).repeat(2, 1, 1)
    expected[1, 0, 3] = 1
    torch.testing.assert_close(found, expected)


def test_poses_relative_to_their_average_have_the_identity_as_average() -> None:
    poses = torch.stack([turned(0.1 * k, [k, k * k, 1 - k]) for k in range(5)])
    centred = relative_to(average_pose(poses), poses)
    torch.testing.assert_close(average_pose(centred), torch.eye(3, 4, dtype=torch.float64))
