"""The hot operations in plain PyTorch: what the equations say, once each.

Imports go down this list, never up:

| module | functions |
|---|---|
| ``adam`` | ``GridAdam``: the optimiser made of ``adam_step``'s steps |
| ``adam_step`` | ``adam_step``: one step on one tensor; ``add_total_variation_gradient`` |
| ``color_network`` | ``decode``: features and directions → RGB |
| ``motion`` | ``cycle_error``, ``flow_error``: the cycle and the flow term |
| ``photometric`` | the terms that compare rays with images |
| ``pixel_rays`` | ``gather_pixels``: rays and truth; ``steps_between`` |
| ``trilinear`` | ``interpolate``: values of a grid between its points; ``resample`` |
| ``compositing`` | ``composite``: weights; ``color_and_depth`` |
| ``corners`` | ``to_grid``: positions in a box to grid coordinates |
"""
