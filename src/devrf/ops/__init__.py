"""The hot operations in plain PyTorch: each equation once.

Autograd differentiates them. They are the definitions of the kernels (:mod:`devrf.kernels`), and
compute where those do not run.

| module | functions |
|---|---|
| ``march`` | ``march``: samples, warped and composited |
| ``trilinear`` | ``interpolate``: values of a grid between its points; ``resample`` |
| ``compositing`` | ``composite``: weights; ``composite_colors``; ``mean_distance``: depths |
| ``splatting`` | ``splat``: a picture of 3D Gaussians |
| ``spherical_harmonics`` | ``spherical_harmonics`` of directions |
| ``photometric`` | the terms that compare rays with images |
| ``adam`` | ``adam_step``: one step on one tensor; ``add_total_variation_gradient`` |
"""
