"""Arrays of numbers in ``.npy`` files: read without executing anything, and checked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from devrf.scenes.validation import LARGEST, problem

Numbers = npt.NDArray[np.float64]


def read_numbers(path: Path, expected: str) -> Numbers:
    """The array in ``path``, in double precision.

    Args:
        path: an ``.npy`` file.
        expected: what it should hold, in words, for the message.

    Raises:
        DevrfError: there is no such file, it is damaged, holds no numbers, or NaN or infinity.
    """
    if not path.is_file():
        raise problem(path, f"no such file; expected {expected}")
    try:
        # Mapped, so that a header which promises more than the file holds costs no memory.
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(stored, np.ndarray):  # an npz under another name
            raise ValueError("an archive of arrays, not one array")
        kind = stored.dtype.kind
        values = np.array(stored, dtype=np.float64) if kind in "fiu" else None
    except (OSError, ValueError, TypeError, EOFError, SyntaxError, MemoryError) as error:
        raise problem(path, f"not a readable npy file ({error}); write it again") from None
    if values is None:
        raise problem(path, f"holds values of type {stored.dtype}, expected {expected}")
    if not bool((np.abs(values) < LARGEST).all()):  # NaN compares false
        raise problem(path, "holds NaN or infinity; write it again from valid camera poses")
    return values
