"""DeVRF: fast deformable voxel radiance fields for dynamic scenes."""

from importlib.util import find_spec

__version__ = "0.1.0"

if find_spec("torchvision") is not None:
    # Before anything imports Lightning.
    from devrf.system.torchvision import pass_over_unusable

    pass_over_unusable()
