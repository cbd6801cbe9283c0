"""The hot kernels: plain PyTorch that states the equation, and Triton for CUDA devices.

| module | functions |
|---|---|
| ``trilinear`` | ``interpolate``: values of a grid between its points |
| ``warped_depth`` | ``warped_depth``: points of a moment → canonical positions, optical depths |
| ``search`` | ``find_samples``: which samples can be seen; ``select``: some of them |
| ``compositing`` | ``composite``, ``composite_segments``: weights; ``sum_segments``: sums |
| ``total_variation`` | ``total_variation``; ``add_total_variation_gradient`` in closed form |
| ``adam_step`` | ``adam_step``, ``smooth_adam_step``: one step on one tensor |
| ``adam`` | ``GridAdam``: the optimiser made of such steps |
| ``corners`` | ``to_grid``: positions in a box to grid coordinates |
| ``choice`` | ``using``: which implementation runs |
| ``spans`` | ``span``: which part of the work is being done, for whoever measures |
| ``selfcheck`` | ``check_kernels``: do both agree on this device? |

Shapes never depend on data in ``warped_depth``, ``find_samples`` (with Triton), ``select``,
``composite_segments``, ``sum_segments`` and ``adam_step`` (with Triton, or without ``skip_zero``),
and nothing in them waits for the device: what a CUDA graph needs. Call each once before capturing,
so that kernels are compiled and constants are on the device.
"""
