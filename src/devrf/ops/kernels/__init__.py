"""The Triton twins of the functions in devrf.ops: imported, and compiled, when one is first run.

Tensors are float32 and contiguous when they come here; the functions of devrf.ops see to it.
Products are summed in float32. Rows of a grid are numbered in int32, places in memory in int64.
Kernels are not compiled anew for other sizes of grids and batches (Adam's have two forms: rows
that can be read in fours, and others), but for other numbers of channels and block sizes.
"""
