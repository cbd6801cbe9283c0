"""Flow files: read, checked, made smaller; numbers by hand, images that are not square."""

from __future__ import annotations

import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from devrf.errors import DevrfError
from devrf.scenes.flow_files import load_flow, read_flow_file
from devrf.scenes.resampling import area_average, shrink_flow


def write_flow(path: Path, vectors: np.ndarray, mask: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, flow=vectors, mask=mask)


def test_shrinking_scales_each_axis_by_its_own_factor():
    vectors = np.empty((6, 12, 2), dtype=np.float32)
    vectors[...] = (6.0, 9.0)
    shrunk, valid = shrink_flow(vectors, np.ones((6, 12), bool), width=4, height=3)
    assert shrunk.shape == (3, 4, 2)
    assert valid.all()
    np.testing.assert_allclose(shrunk[..., 0], 6.0 * 4 / 12, rtol=1e-6)
    np.testing.assert_allclose(shrunk[..., 1], 9.0 * 3 / 6, rtol=1e-6)


def test_shrinking_averages_trusted_vectors_only_and_needs_half_of_them():
    vectors = np.zeros((2, 4, 2), dtype=np.float32)
    vectors[:, :, 0] = [[2, 4, 8, 8], [900, 900, 900, 900]]
    valid = np.array([[True, True, True, False], [False] * 4])
    shrunk, trusted = shrink_flow(vectors, valid, width=2, height=1)
    np.testing.assert_array_equal(trusted, [[True, False]])  # 2 of 4, then 1 of 4
    np.testing.assert_allclose(shrunk[0, :, 0], [(2 + 4) / 2 / 2, 0])


def test_area_averages_count_fractions_of_cells():
    row = np.array([[[0], [3], [6]]], dtype=np.float32)
    # Two cells of 1.5 pixels each: (1·0 + 0.5·3) / 1.5 and (0.5·3 + 1·6) / 1.5.
    np.testing.assert_allclose(area_average(row, width=2, height=1)[0, :, 0], [1, 5], rtol=1e-6)


def test_masked_nan_and_infinite_vectors_are_invalid_and_zero(tmp_path):
    vectors = np.ones((3, 5, 2), dtype=np.float32)
    vectors[0, 0, 1], vectors[1, 2, 0] = np.nan, np.inf
    mask = np.ones((3, 5), dtype=np.uint8)
    mask[2, 4] = 0
    write_flow(tmp_path / "f.npz", vectors, mask)
    read, valid = read_flow_file(tmp_path / "f.npz", width=5, height=3)
    assert {tuple(p) for p in np.argwhere(~valid)} == {(0, 0), (1, 2), (2, 4)}
    assert (read[~valid] == 0).all() and (read[valid] == 1).all()


def test_a_member_that_is_no_array_is_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "001_bwd.npz", "w") as archive:
        archive.writestr("flow", "text")
    with pytest.raises(DevrfError, match='001_bwd.npz: "flow" has shape '):
        read_flow_file(tmp_path / "001_bwd.npz", width=6, height=4)


def test_wrong_arrays_are_named(tmp_path):
    path = tmp_path / "001_bwd.npz"
    write_flow(path, np.ones((6, 4, 2)), np.ones((4, 6)))
    with pytest.raises(DevrfError, match="001_bwd.npz"):
        read_flow_file(path, width=6, height=4)


def test_flow_of_an_image_larger_than_a_films_is_not_read(tmp_path):
    with pytest.raises(DevrfError, match="flow of 13000x13000 px, expected 8192x4320 at most"):
        read_flow_file(tmp_path / "a.npz", width=13_000, height=13_000)


def test_packed_arrays_larger_than_an_image_are_not_unpacked(tmp_path):
    path = tmp_path / "001_bwd.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("flow.npy", "w", force_zip64=True) as member,
    ):
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f4", "fortran_order": False, "shape": (2**14, 2**11, 2)}
        )
        for _ in range(2**6):
            member.write(bytes(2**22))
    assert path.stat().st_size < 2**19
    tracemalloc.start()
    try:
        with pytest.raises(DevrfError, match=r"flow.npy is larger than numbers of shape \(4, 6, 2"):
            read_flow_file(path, width=6, height=4)
        assert tracemalloc.get_traced_memory()[1] < 2**22
        assert load_flow(path, "key", (1, 4, 6)) is None
    finally:
        tracemalloc.stop()


def test_an_array_in_place_of_packed_ones_is_not_read(tmp_path):
    path = tmp_path / "001_bwd.npz"
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (2**26,)}
        np.lib.format.write_array_header_1_0(file, header)
        file.truncate(2**29)  # of zeros
    tracemalloc.start()
    try:
        with pytest.raises(DevrfError, match=r"001_bwd.npz: not a readable npz"):
            read_flow_file(path, width=6, height=4)
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("numbers", [1, 2, 3])
def test_kept_flow_has_two_numbers_a_pixel(tmp_path, numbers):
    arrays = {"vectors": np.zeros((1, 4, 6, numbers)), "valid": np.ones((1, 4, 6), bool)}
    np.savez(tmp_path / "flow.npz", key=np.array("key"), **arrays)
    assert (load_flow(tmp_path / "flow.npz", "key", (1, 4, 6)) is not None) == (numbers == 2)
