"""Cameras found with and without moving pixels, and those taken; COLMAP is stood in for."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from devrf.apps.capture import structure
from devrf.apps.settings import CaptureSettings

NAMES = [f"{k}.png" for k in range(8)]


def covering(first=0, last=0):
    """Masks (10, 100) that are 0, of what moves, from a tenth of their width to another."""
    mask = np.full((10, 100), 255, np.uint8)
    mask[:, round(10 * first) : round(10 * last)] = 0
    return dict.fromkeys(NAMES, mask) if last > first else {}


def still(mask):
    """How many tenths of the width are not masked."""
    return (mask[0] > 0).sum() / 10


@pytest.fixture
def reconstruct(monkeypatch, tmp_path):
    """Runs structure from motion whose passes find what they are told; returns what is taken.

    ``movers``: masked tenths, from and to, by the cameras of each pass; ``errors``: of what stands
    still by each; ``placed``: how many images the two mappers place in each, None if none. Of as
    many images the global mapper's have less error. With it come the tenths of the width in which
    features were looked for, and those in which errors were.
    """
    masked: list[float] = []
    judged: list[float] = []

    def run(movers, errors, placed):
        def mapped(images, work, mapper, into):
            count = placed[len(masked)][mapper == "global"]
            error = 0.5 if mapper == "incremental" else 0.4
            return count and structure._Mapped(mapper, Path(str(len(masked)), mapper), count, error)

        class MonocularVideo:
            def __init__(self, images, names):
                assert names == NAMES

            def motion_masks(self, model):
                return covering(*movers[model.number])

            def static_error(self, model, masks):
                seen = {still(mask) for mask in masks.values()}
                judged.append(*seen)
                return errors[model.number] if judged[-1] else float("inf")

        def match(images, work, moving, fixed, settings, masks):
            if masks:
                masked.append(still(masks[NAMES[0]]))

        def read(folder):
            number = int(folder.parts[0])
            names = NAMES[: placed[number][folder.name == "global"]]
            return SimpleNamespace(number=number, images=[SimpleNamespace(name=n) for n in names])

        monkeypatch.setattr(structure, "_match", match)
        monkeypatch.setattr(structure, "_mapped", mapped)
        monkeypatch.setattr(structure, "MonocularVideo", MonocularVideo)
        monkeypatch.setattr(structure, "_shows_no_depth", lambda base: False)
        monkeypatch.setattr(structure, "read_model", read)
        monkeypatch.setattr(structure, "colmap", _Library)
        moving = SimpleNamespace(names=NAMES, motion=None, path=tmp_path)
        settings = CaptureSettings(into=tmp_path, views=[tmp_path])
        folder = structure.reconstruct(tmp_path, tmp_path, moving, [], settings)
        return "/".join(folder.parts), masked, sorted({*judged})

    return run


class _Library:
    logging = SimpleNamespace(minloglevel=0)

    def set_random_seed(self, seed):
        assert seed == 0


ALL = (8, 8)


def test_cameras_are_found_again_until_masks_stay(reconstruct):
    # By the first cameras three tenths move, by those of the next pass five, and so on. All are
    # compared where none of them sees anything move.
    taken = reconstruct([(0, 3), (0, 5), (0, 5), ()], [0.3, 0.2, 0.1, 0.0], [ALL] * 4)
    assert taken == ("2/global", [7, 5], [5])


def test_they_are_not_found_more_than_so_often(reconstruct):
    movers = [(0, 1), (0, 2), (0, 3), (0, 4), (0, 5)]
    taken = reconstruct(movers, [0.4, 0.3, 0.2, 0.1, 0.0], [ALL] * 5)
    assert taken == ("3/global", [9, 8, 7], [7])


@pytest.mark.parametrize(
    ("errors", "placed", "taken"),
    [
        ([0.1, 0.2], [ALL, ALL], "0/incremental"),  # masks leave too little to find cameras by
        ([0.1, 0.102], [ALL, ALL], "1/global"),  # as good, and closer to its features
        ([0.2, 0.1], [ALL, (7, 7)], "0/incremental"),  # too few are placed without moving pixels
        ([0.2, 0.1], [ALL, (None, None)], "0/incremental"),  # none are
        ([0.2, 0.1], [ALL, (8, None)], "1/incremental"),
        ([0.1, 0.2], [(5, 5), ALL], "1/global"),  # many more are
    ],
)
def test_those_are_taken_that_what_stands_still_agrees_with(reconstruct, errors, placed, taken):
    assert reconstruct([(0, 3), (0, 3)], errors, placed)[0] == taken


@pytest.mark.parametrize("last", [ALL, (2, 2)])
def test_cameras_that_follow_what_moves_do_not_judge_the_first(reconstruct, last):
    # The first ones see the thing move; those of the next pass follow it, and see the wall move.
    movers = [(0, 3), (3, 10), (3, 10)]
    assert reconstruct(movers, [0.1, 0.2, 0.2], [ALL, ALL, last])[0] == "0/incremental"


def test_where_nothing_moves_both_mappers_see_all(reconstruct):
    assert reconstruct([()], [0.1], [ALL]) == ("0/global", [], [])


def test_masks_stay_where_better_cameras_see_nothing_move(reconstruct):
    taken = reconstruct([(0, 3), ()], [0.3, 0.2], [ALL, ALL])
    assert taken == ("1/global", [7], [7])


def test_little_that_moves_is_left_out_too(reconstruct):
    # 3 % of the pixels: less than what counts as a change of masks.
    taken = reconstruct([(0, 0.3), (0, 0.3)], [0.3, 0.2], [ALL, ALL])
    assert taken == ("1/global", [9.7], [9.7])
