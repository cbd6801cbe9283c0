"""The hot operations as kernels that Warp compiles for the CPU and for CUDA: one source for both.

Each module defines kernels, and the functions that launch them. These functions call their
definition in :mod:`devrf.ops` for tensors that kernels do not support
(:func:`devrf.kernels.runtime.is_supported`), or their callers do. Every kernel is tested against
its definition.

| module | functions |
|---|---|
| ``pixels`` | ``look_up``: rays, colours and flow of a batch; defined in ``methods.batch`` |
| ``march`` | ``march``: samples, warped and composited |
| ``trilinear`` | ``interpolate``: values of a grid between its points |
| ``compositing`` | ``composite_colors``: colours of rays |
| ``photometric`` | ``photometric``: the terms that compare rays with images, weighted |
| ``deformation`` | ``cycle_error``, ``flow_error``; defined in ``methods.devrf.losses`` |
| ``splatting`` | ``splat``: a picture of 3D Gaussians |
| ``adam`` | ``adam_step``, ``add_total_variation_gradient``: a step of the optimiser |
| ``grid`` | shared by the kernels: grids, and the cell that holds a point |
| ``displacement`` | shared by the kernels: the warp, and its adjoint |
| ``adjoint`` | ``with_adjoint``: results of kernels for autograd |
| ``runtime`` | tensors that kernels support, and launches |
"""
