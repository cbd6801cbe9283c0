"""DeVRF, in modules that follow the paper and docs/method.md.

1. Canonical field: ``architecture``, ``voxel_grid``, ``canonical_field``, ``color_decoder``.
2. Rays, samples, compositing: ``volume_rendering``; then ``losses``.
3. Canonical stage: ``canonical_schedule``, ``grid_resolution``, ``free_space``, ``depth_crop``,
   ``canonical_stage``.
4. Deformation field: ``deformation_field``, ``grid_warp``, ``deformed_occupancy``.
5. Deformation stage: ``deformation_schedule``, ``deformation_stage``; beyond the paper
   ``flow_tracks``, ``flow_initialisation`` and ``convergence``.

``settings`` has the defaults of both stages and ``voxel_stage`` what they share; ``model`` and
``view`` are the learned scene. Memory and files: ``active_frame``, ``frame_memory``,
``pixel_selection``, ``compact_state``. ``static_shape`` renders the same where shapes must not
depend on data, for CUDA graphs and Triton.
"""
