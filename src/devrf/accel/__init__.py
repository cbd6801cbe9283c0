"""How a GPU runs the operations of :mod:`devrf.ops`: a Triton kernel for each, with its backward.

Nobody needs this package to understand a method: what is computed is said in ``devrf.ops``, whose
functions of the same names call these where Triton runs. Modules are imported, and kernels
compiled, at the first use.

Tensors are float32 and contiguous unless said otherwise. Products are summed in float32. Rows of a
grid are int32, offsets in memory int64. Kernels are compiled once for all sizes of grids and
batches (Adam's in two forms, with and without vector loads), and again for other numbers of
channels and block sizes.

A grid in a box comes with its *axes*: nine float32 on the device, for x, y, z the low corner, the
grid points per unit of length, and the number of grid points.
"""
