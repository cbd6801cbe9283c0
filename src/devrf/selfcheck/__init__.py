"""Checks of the machine: what runs on its device, and whether it does there what is promised.

| module | content |
|---|---|
| ``runner`` | runs checks one after another, each in a process of its own; their verdicts |
| ``checks`` | every check, and which of them a device can do |
| ``kernel_checks`` | Triton's kernels beside their PyTorch twins |
| ``learning_checks`` | loss curves by graphs, kernels and precision; determinism |
| ``graph_checks`` | capture as CUDA graphs; waits for the device |
| ``resume_checks`` | a stage is stopped by a signal and goes on |
| ``memory_checks`` | memory runs out in warm-up, in capture, and for good |
| ``rendering_checks`` | pictures of both implementations, frames a second |
| ``ceilings`` | how fast the device copies and multiplies |
| ``bench`` | the small scene, and how stages learn it |
| ``finding`` | what a check has found |
"""
