"""Triton implementations of the functions in devrf.ops: imported and compiled at the first use.

Callers in devrf.ops pass float32 tensors that are contiguous. Products are summed in float32. Rows
of a grid are int32, offsets in memory int64. Kernels are compiled once for all sizes of grids and
batches (Adam's in two forms, with and without vector loads), and again for other numbers of
channels and block sizes.
"""
