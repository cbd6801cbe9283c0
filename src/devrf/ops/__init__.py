"""The hot operations: in plain PyTorch, which states the equation, and in Triton for CUDA devices.

Imports go down this list, never up:

| module | functions |
|---|---|
| ``selfcheck`` | ``check_kernels``, ``compare``: both implementations, compared on a device |
| ``adam`` | ``GridAdam``: the optimiser made of ``adam_step``'s steps |
| ``selection`` | ``select_listed``: those whose colour is needed, in a list of their own |
| ``search`` | ``find_samples``: visible samples of rays; ``select``: a subset of them |
| ``adam_step`` | ``adam_step``, ``smooth_adam_step``: one step on one tensor |
| ``color_network`` | ``listed_colors``, ``decode``: features and directions → RGB |
| ``motion`` | ``motion_sum``: the cycle and the flow term |
| ``photometric`` | ``photometric_sum``: the terms that compare rays with images |
| ``pixel_rays`` | ``gather_pixels``: rays and truth; ``steps_in_box``, ``steps_between`` |
| ``warped_depth`` | ``warped_depth``: points of a moment → canonical positions, optical depths |
| ``trilinear`` | ``interpolate``: values of a grid between its points |
| ``compositing`` | ``composite``, ``composite_segments``: weights; ``sum_segments``: sums |
| ``total_variation`` | ``total_variation``; ``add_total_variation_gradient`` in closed form |
| ``dispatch`` | ``using``, ``triton_runs``: which implementation runs |
| ``kernels`` | Triton's implementations |
| ``corners`` | ``to_grid``: positions in a box to grid coordinates |

Shapes never depend on data in ``warped_depth``, ``find_samples`` (with Triton), ``select``,
``composite_segments``, ``sum_segments`` and ``adam_step`` (with Triton, or without ``skip_zero``),
and nothing in them waits for the device, as a CUDA graph requires. Call each once before capturing,
so that kernels are compiled and constants are on the device.
"""

from devrf.ops.dispatch import register_check
from devrf.ops.selfcheck import check_kernels

register_check(check_kernels)
