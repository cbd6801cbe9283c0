"""Kernels that are compiled ahead are those that are launched."""

from __future__ import annotations

from typing import Any

import torch
from warp import Kernel

from devrf.engine.protocol import Protocol
from devrf.engine.stage import Stage
from devrf.geometry.box import Box
from devrf.kernels.adam import adam_kernel, adam_step
from devrf.kernels.ahead import compile_ahead, grid_kernels, splatting_kernels
from devrf.kernels.march import march_kernel
from devrf.kernels.trilinear import add_kernel, interpolate, interpolate_kernel, slope_kernel
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.dnerf.model import DNeRF
from devrf.methods.gaussians.model import DeformableGaussians
from devrf.methods.image_stage import ImageStage
from devrf.methods.kplanes.model import KPlanes
from devrf.methods.kplanes.settings import KPlanesSettings
from devrf.methods.ray_stage import RayStage
from devrf.methods.tineuvox.model import TiNeuVox
from devrf.methods.tineuvox.settings import TiNeuVoxSettings
from devrf.ops.adam import AdamRule

CHANNELS = 5  # no other test's


def test_what_was_compiled_ahead_is_not_compiled_again() -> None:
    compile_ahead(grid_kernels({CHANNELS}), torch.device("cpu")).join()
    made = (interpolate_kernel, slope_kernel, add_kernel, adam_kernel)
    modules = [make(CHANNELS).module for make in made]
    built = [set(module.execs) for module in modules]
    assert all(built)
    grid = torch.ones(2, 2, 2, CHANNELS, requires_grad=True)
    points = torch.full((1, 3), 0.5, requires_grad=True)
    interpolate(grid, points, Box((0.0,) * 3, (1.0,) * 3)).sum().backward()
    assert grid.grad.sum() == CHANNELS and not points.grad.any()
    with torch.no_grad():
        adam_step(grid, grid.grad, torch.zeros_like(grid), torch.zeros_like(grid), AdamRule(0.1, 1))
    assert [set(module.execs) for module in modules] == built


def kernels(stage: type[Stage], **settings: Any) -> list[Kernel]:
    """The kernels of the only stage of a protocol."""
    protocol = Protocol("joint", {"joint": {"capture": "both"}})
    return [*stage.plan(stage, settings, protocol, "joint").kernels]


def test_methods_with_grids_say_which_kernels_they_take() -> None:
    proposals = KPlanesSettings(sampling="proposals", channels=7, proposal_channels=2, resolution=4)
    planes = kernels(RayStage, model=KPlanes(proposals))
    assert {interpolate_kernel(7), interpolate_kernel(2), adam_kernel(7)} <= set(planes)
    voxels = kernels(RayStage, model=TiNeuVox(TiNeuVoxSettings(side=8, channels=9)))
    assert interpolate_kernel(9) in voxels and march_kernel(False) not in voxels
    assert kernels(RayStage, model=DNeRF()) == []
    assert kernels(ImageStage, model=DeformableGaussians()) == splatting_kernels()
    stage = kernels(CanonicalStage, architecture=Architecture(channels=11))
    assert {march_kernel(False), interpolate_kernel(3), interpolate_kernel(11)} <= set(stage)
