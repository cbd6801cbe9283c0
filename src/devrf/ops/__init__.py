"""The hot operations in plain PyTorch: what the equations say, once each.

Where Triton runs, an operation is carried out by the module of its name in :mod:`devrf.accel`.
Imports go down this list, never up:

| module | functions |
|---|---|
| ``check`` | ``check_kernels``: both implementations, compared on a device |
| ``adam`` | ``GridAdam``: the optimiser made of ``adam_step``'s steps |
| ``search`` | ``find_samples``: visible samples of rays; ``select_listed`` of them |
| ``adam_step`` | ``adam_step``: one step on one tensor; ``add_total_variation_gradient`` |
| ``color_network`` | ``listed_colors``, ``decode``: features and directions → RGB |
| ``motion`` | ``motion_sum``: the cycle and the flow term |
| ``photometric`` | ``photometric_sum``: the terms that compare rays with images |
| ``pixel_rays`` | ``gather_pixels``: rays and truth; ``steps_in_box``, ``steps_between`` |
| ``warped_depth`` | ``warped_depth``: points of a moment → canonical positions, optical depths |
| ``trilinear`` | ``interpolate``: values of a grid between its points; ``resample`` |
| ``compositing`` | ``composite``, ``composite_segments``: weights; ``composite_colors`` |
| ``dispatch`` | ``using``, ``accelerated``: which implementation runs |
| ``corners`` | ``to_grid``: positions in a box to grid coordinates |

Shapes never depend on data in ``warped_depth``, ``find_samples`` (with Triton), ``select``,
``composite_segments`` and ``adam_step`` (with Triton, or without ``skip_zero``),
and nothing in them waits for the device, as a CUDA graph requires. Call each once before capturing,
so that kernels are compiled and constants are on the device.
"""

from devrf.ops.check import check_kernels
from devrf.ops.dispatch import register_check

register_check(check_kernels)
