"""Every kernel compiles for NVIDIA's GPUs, whether there is one or not."""

from __future__ import annotations

import inspect
import pkgutil
import sys
from importlib import import_module
from pathlib import Path

import pytest
import torch
import warp as wp

import devrf.kernels
from devrf.kernels.runtime import is_supported

# Densities, displacements, features.
CHANNELS = (1, 3, 12)
# Whether it is contracted.
SPACES = (False, True)
# Whether images have an alpha mask.
ALPHAS = (False, True)
# Ampere and Blackwell: no kernel has code of an architecture's own, so that those between do, too.
ARCHITECTURES = (80, 120)


def every_kernel() -> dict[str, wp.Kernel]:
    """All kernels by names of their own; a factory's, for each number of channels or space."""
    found: dict[str, wp.Kernel] = {}
    for info in pkgutil.iter_modules(devrf.kernels.__path__):
        module = import_module(f"devrf.kernels.{info.name}")
        for name, value in vars(module).items():
            if getattr(value, "__module__", module.__name__) != module.__name__:
                continue  # another module's
            if isinstance(value, wp.Kernel):
                if value.func.__module__ == module.__name__:
                    found[f"{info.name}.{name}"] = value
            elif hasattr(value, "__wrapped__"):
                signature = inspect.signature(value)
                if signature.return_annotation in (wp.Kernel, "wp.Kernel"):
                    (what,) = signature.parameters
                    choices = {"channels": CHANNELS, "contracted": SPACES, "has_alpha": ALPHAS}[
                        what
                    ]
                    found |= {f"{info.name}.{name}_{one}": value(one) for one in choices}
    return found


@pytest.fixture(scope="module")
def together() -> wp.Module:
    """All kernels in one module: the compiler reads Warp's own functions once, not for each."""
    assert is_supported(torch.zeros(1))  # starts Warp
    module = wp.get_module("devrf_kernels_together")
    module.made = [
        wp.Kernel(kernel.func, key=name.replace(".", "_"), module=module, options=kernel.options)
        for name, kernel in every_kernel().items()
    ]
    return module


def test_all_are_found() -> None:
    trilinear = ("interpolate_kernel", "slope_kernel", "add_kernel")
    names = {f"trilinear.{one}_{n}" for one in trilinear for n in CHANNELS}
    steps = ("adam_kernel", "total_variation_kernel")
    names |= {f"adam.{one}_{n}" for one in steps for n in CHANNELS}
    names |= {f"march.march_kernel_{n}" for n in SPACES}
    march = ("adjoint_kernel", "keep_significant_kernel", "scatter_kernel")
    names |= {f"march.{one}" for one in march}
    names |= {"compositing.composite_kernel", "photometric.photometric_kernel"}
    names |= {"motion.cycle_kernel", "motion.flow_kernel"}
    names |= {f"pixels.look_up_kernel_{n}" for n in ALPHAS}
    splatting = ("project", "list", "composite", "composite_adjoint", "project_adjoint")
    names |= {f"splatting.{one}_kernel" for one in splatting}
    assert set(every_kernel()) == names


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no compiler for CUDA there")
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_kernel_compiles(together: wp.Module, architecture: int, tmp_path: Path) -> None:
    (made,) = wp.compile_aot_module(together, arch=architecture, module_dir=tmp_path, use_ptx=False)
    code = made.read_bytes()
    assert made.suffix == ".cubin" and together.made
    for kernel in together.made:
        assert f"{kernel.get_mangled_name()}_cuda_kernel_forward".encode() in code, kernel.key
