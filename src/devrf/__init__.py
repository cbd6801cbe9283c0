"""DeVRF: fast deformable voxel radiance fields for dynamic scenes."""

__version__ = "0.1.0"
