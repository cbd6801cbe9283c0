"""DeVRF, in modules that follow the paper and docs/method.md.

1. Canonical field: ``canonical_field``; its sizes, ``architecture``.
2. Rays, samples, compositing: ``volume_rendering``; then ``losses``.
3. Canonical stage: ``canonical_schedule``, ``free_space``, ``canonical_stage``.
4. Deformation field and warp: ``deformation_field``.
5. Deformation stage: ``deformation_schedule``, ``deformation_loss``, ``extension`` (what may be
   added), ``deformation_stage``.

``settings`` has the defaults of the stages, which are :class:`devrf.engine.stage.Stage`;
``model`` and ``view`` are the learned scene. ``extensions`` has what goes beyond the paper.
"""
