"""The average of poses, by hand."""

from __future__ import annotations

import math

import torch

from devrf.geometry.average_pose import average_pose, recentred, relative_to


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


def test_a_pose_relative_to_itself_is_the_identity() -> None:
    pose = turned(0.7, [1, -2, 5])
    torch.testing.assert_close(
        relative_to(pose, pose[None])[0], torch.eye(3, 4, dtype=torch.float64)
    )
    # A camera one unit to the right of it, along its own x axis.
    other = pose.clone()
    other[:, 3] += pose[:, 0]
    torch.testing.assert_close(
        relative_to(pose, other[None])[0, :, 3], torch.tensor([1.0, 0, 0], dtype=torch.float64)
    )


def test_recentring_once_is_enough() -> None:
    poses = torch.stack([turned(0.1 * k, [k, k * k, 1 - k]) for k in range(5)])
    once = recentred(poses)
    torch.testing.assert_close(average_pose(once), torch.eye(3, 4, dtype=torch.float64))
    torch.testing.assert_close(recentred(once), once)
