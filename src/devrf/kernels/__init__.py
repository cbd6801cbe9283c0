"""The hot operations as kernels that Warp compiles for the CPU and for CUDA: one source for both.

Each module defines kernels, and the functions that launch them. On tensors that kernels do not
support (:func:`devrf.kernels.runtime.is_supported`) these functions call their definition in
:mod:`devrf.ops`, against which every kernel is tested.

| module | functions |
|---|---|
| ``march`` | ``march``: samples, warped and composited |
| ``trilinear`` | ``interpolate``: values of a grid between its points |
| ``adam`` | ``adam_step``, ``add_total_variation_gradient``: a step of the optimiser |
| ``grid`` | shared by the kernels: grids, and the cell that holds a point |
| ``runtime`` | tensors that kernels support, and launches |
"""
