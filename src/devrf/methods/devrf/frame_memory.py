"""How much memory the displacements of all frames take, and whether a GPU has room for them."""

from __future__ import annotations

Shape = tuple[int, int, int]

# A displacement: three float32.
DISPLACEMENT = 12
# Grids of one frame while it is learned: both directions and the forward one of the frame before
# (3), gradients (2), Adam moments (4), and the copy that a rollback returns to (2).
ACTIVE_GRIDS = 11
# The share of a GPU's free memory that frames may take. The rest is for images, the canonical
# field and batches.
FRAMES_SHARE = 0.75


def resident_bytes(frames: int, shape: Shape, half: bool) -> int:
    """Bytes of the displacements of all frames in both directions.

    Args:
        frames: number of frames T.
        shape: grid points along x, y, z.
        half: whether they are stored in half precision.
    """
    x, y, z = shape
    return 2 * frames * x * y * z * DISPLACEMENT // (2 if half else 1)


def active_bytes(shape: Shape) -> int:
    """Bytes of one frame, on a grid of ``shape``, while it is learned."""
    x, y, z = shape
    return ACTIVE_GRIDS * x * y * z * DISPLACEMENT


def fits_on_device(free: int, frames: int, shape: Shape, *, half: bool, parallel: int) -> bool:
    """Whether a GPU has room for all frames beside everything else that the stage needs.

    Args:
        free: bytes free on the GPU.
        frames: number of frames T.
        shape: grid points of the finest level.
        half: whether the frames are stored in half precision.
        parallel: how many frames are learned at the same time.
    """
    needed = resident_bytes(frames, shape, half) + parallel * active_bytes(shape)
    return needed <= FRAMES_SHARE * free
