"""The Triton twins of the functions in devrf.ops: imported, and compiled, when one is first run.

Tensors are float32 and contiguous when they come here; the functions of devrf.ops see to it.
Products are summed in float32. Rows of a grid are numbered in int32, places in memory in int64.
Sizes of grids and of batches are not specialised on, so that a new resolution needs no new
compilation; numbers of channels and block sizes are.
"""
