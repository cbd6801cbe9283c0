"""Which cameras are taken of those found with and without what moves; COLMAP is stood in for."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from devrf.apps.capture import structure
from devrf.apps.settings import CaptureSettings

NAMES = [f"{k}.png" for k in range(8)]


def covering(columns):
    """Masks (10, 10) whose first columns are 0: of what moves."""
    mask = np.full((10, 10), 255, np.uint8)
    mask[:, :columns] = 0
    return dict.fromkeys(NAMES, mask) if columns else {}


@pytest.fixture
def reconstruct(monkeypatch, tmp_path):
    """Runs structure from motion whose passes find what they are told; returns the folder's name.

    ``movers``: masked columns by the cameras of each pass; ``errors``: of what stands still by
    each; ``placed``: how many images each places. The global mapper always has the least error.
    """
    masked: list[int] = []

    def run(movers, errors, placed):
        def mapped(images, work, mapper, into):
            number = len(masked)
            error = 0.5 if mapper == "incremental" else 0.4
            return structure._Mapped(mapper, Path(str(number), mapper), placed[number], error)

        class Film:
            def __init__(self, images, names):
                assert names == NAMES

            def masks_of_movers(self, model):
                return covering(movers[model])

            def error_of_still(self, model, masks):
                assert (masks[NAMES[0]][0] == 0).sum() == masked[-1]
                return errors[model]

        def match(images, work, moving, fixed, settings, masks):
            if masks:
                masked.append(int((masks[NAMES[0]][0] == 0).sum()))

        monkeypatch.setattr(structure, "_match", match)
        monkeypatch.setattr(structure, "_mapped", mapped)
        monkeypatch.setattr(structure, "Film", Film)
        monkeypatch.setattr(structure, "_shows_no_depth", lambda base: False)
        monkeypatch.setattr(structure, "read_model", lambda folder: int(folder.parts[0]))
        monkeypatch.setattr(structure.importlib, "import_module", lambda name: _Library())
        moving = SimpleNamespace(names=NAMES, still=None, path=tmp_path)
        settings = CaptureSettings(into=tmp_path, views=[tmp_path])
        folder = structure.reconstruct(tmp_path, tmp_path, moving, [], settings)
        return "/".join(folder.parts), masked

    return run


class _Library:
    logging = SimpleNamespace(minloglevel=0)

    def set_random_seed(self, seed):
        assert seed == 0


def test_cameras_are_found_again_until_masks_stay(reconstruct):
    # By the first cameras three columns move, by those of the next pass five, and so on.
    assert reconstruct([3, 5, 5, 7], [0.3, 0.2, 0.1, 0.0], [8, 8, 8, 8]) == ("2/global", [3, 5])


def test_they_are_not_found_more_than_so_often(reconstruct):
    taken = reconstruct([1, 2, 3, 4, 5], [0.4, 0.3, 0.2, 0.1, 0.0], [8] * 5)
    assert taken == ("3/global", [1, 2, 3])


@pytest.mark.parametrize(
    ("errors", "placed", "taken"),
    [
        ([0.1, 0.2], [8, 8], "0/incremental"),  # masks leave too little to find cameras by
        ([0.2, 0.1], [8, 7], "0/incremental"),  # too few are placed without what moves
        ([0.1, 0.2], [5, 8], "1/global"),  # many more are
    ],
)
def test_those_are_taken_that_what_stands_still_agrees_with(reconstruct, errors, placed, taken):
    assert reconstruct([3, 3], errors, placed) == (taken, [3])


def test_where_nothing_moves_both_mappers_see_all(reconstruct):
    assert reconstruct([0], [0.1], [8]) == ("0/global", [])
